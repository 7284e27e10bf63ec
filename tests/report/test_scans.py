"""Pictures of scans and of the scenes that they are cut from."""

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from PIL import Image

from qs3.answers.answer import Answer
from qs3.clouds.files import SCENE_RECORD
from qs3.errors import InputError
from qs3.geometry import rigid, rotation_z
from qs3.objects.cut import upright
from qs3.objects.scene_files import SceneSettings
from qs3.objects.segment import SegmentedObject
from qs3.parts.places import Place
from qs3.report import scans
from qs3.report.figure import write_png
from qs3.report.parts_page import parts_page
from qs3.report.scans import Tile, draw_poses, draw_scene, scan_sheet, write_sheets

from .test_page import Page

EYE = np.array([0.3, -0.4, 2.0])


@pytest.mark.parametrize("camera", ["100,200,60,40", ""])
def test_boxes_stand_where_the_objects_are_seen(rng, monkeypatch, camera):
    """In pixels of a depth image, y down; of a cloud from above, y up."""
    u, v = (grid.ravel() for grid in np.meshgrid(np.arange(120), np.arange(80)))
    z = 1 + 0.1 * rng.random(len(u))
    points = np.stack([(u - 60) / 100 * z, (v - 40) / 200 * z, z], axis=1) @ upright().T
    flat = points[:, :2] if not camera else np.stack([u - 60, 40 - v], axis=1)
    rows = [np.flatnonzero((u >= 10) & (u < 20) & (v >= 50) & (v < 70)), np.array([5, 7])]
    single = points.astype(np.float32)
    objects = [SegmentedObject(single[i], (0.0,) * 3, (1.0,) * 3, 0.0, 1.0, 40.0, i) for i in rows]
    figures = []
    monkeypatch.setattr(scans, "png_bytes", lambda figure, dpi: figures.append(figure) or b"")
    draw_scene(SceneSettings(intrinsics=camera))(points, objects)
    (axes,) = figures[0].axes
    assert [text.get_text() for text in axes.texts] == ["0", "1"]
    for patch, i in zip(axes.patches, rows, strict=True):
        box = patch.get_bbox()
        assert (box.x0, box.y0) == pytest.approx(flat[i].min(axis=0), abs=1e-6)
        assert (box.x1, box.y1) == pytest.approx(flat[i].max(axis=0), abs=1e-6)
    assert axes.images[0].get_extent() == pytest.approx(
        [flat[:, 0].min(), flat[:, 0].max(), flat[:, 1].min(), flat[:, 1].max()], abs=1e-6
    )


def test_a_sheet_draws_each_scan_with_its_edges(rng):
    points = rng.random((50, 3)).astype(np.float32)
    edges = rng.random((4, 2, 3)).astype(np.float32)
    tiles = [Tile(points, "1: bolt? (0.51)"), Tile(points, "b", edges)]
    figure = scan_sheet([*tiles, Tile(points, "c", edges, lost=True)])
    first, *others = figure.axes
    assert first.get_title() == "1: bolt? (0.51)"
    lines = [
        [c for c in axes.collections if isinstance(c, LineCollection)] for axes in (first, *others)
    ]
    assert [len(found) for found in lines] == [0, 1, 1]
    assert len(lines[1][0].get_segments()) == 4
    (red, _, _, _), (grey, *others, _) = (found[0].get_edgecolors()[0] for found in lines[1:])
    assert red > 0.7
    assert others == [grey, grey]


def test_the_tiles_of_a_sheet_do_not_overlap(rng):
    """With captions of two lines and bars for scale; each lies on the sheet."""
    points = rng.random((50, 3)) * (0.3, 0.01, 0.01)
    figure = scan_sheet([Tile(points, "object_000.ply\nbracket 0.97, 1.2 mm, visible 90%")] * 7)
    FigureCanvasAgg(figure).draw()
    boxes = [box for axes in figure.axes if (box := axes.get_tightbbox()) is not None]
    assert len(boxes) == 7
    sheet = figure.bbox
    for number, box in enumerate(boxes):
        assert sheet.x0 <= box.x0 < box.x1 <= sheet.x1
        assert sheet.y0 <= box.y0 < box.y1 <= sheet.y1
        assert box.count_overlaps(boxes[number + 1 :]) == 0


def test_pictures_of_segmented_scans_carry_their_folder(rng, tmp_path, monkeypatch):
    """They are called object_000.ply in every folder; other scans go by their name alone."""
    monkeypatch.setattr(scans, "write_sheets", lambda path, tiles: drawn.extend(tiles) or [])
    drawn, pose = [], {"residual": 1e-3, "noise": 1e-3, "visible": 0.9, "lost": False}
    pose["eye"] = EYE
    best = SimpleNamespace(class_name="bolt", scale=1.0, pose=np.eye(4), **pose)
    (tmp_path / "s").mkdir()
    (tmp_path / "s" / SCENE_RECORD).write_text("{}")
    for files in (
        ("a/object_000.ply", "b/object_000.ply", "a/mine.ply"),
        ("s/object_001.ply", "a/mine.ply"),
    ):
        drawn.clear()
        facts = {
            "probabilities": {"bolt": 1.0},
            "candidates": (best,),
            "points": rng.random((9, 3)),
        }
        facts["edges"] = np.zeros((1, 2, 3), np.float32)
        draw_poses(tmp_path, [Answer(file=tmp_path / file, **facts) for file in files])
        wanted = [*files[:-1], "mine.ply"]
        assert sorted(tile.caption.partition("\n")[0] for tile in drawn) == sorted(wanted)


def test_pictures_come_in_the_order_of_the_page_from_the_side_of_the_camera(rng, monkeypatch):
    """Each shows the axes of the CAD, unless its pose is not believed."""
    monkeypatch.setattr(scans, "write_sheets", lambda path, tiles: drawn.extend(tiles) or [])
    drawn, answers, turn = [], [], rotation_z(0.5)
    for name, share, residual, lost in (
        ("sure", 0.9, 3e-3, False), ("doubtful", 0.4, 1e-3, False), ("lost", 0.9, 2e-3, True),
    ):  # fmt: skip
        found = {"scale": 1.0, "residual": residual, "noise": 1e-3, "visible": 0.9, "lost": lost}
        best = SimpleNamespace(
            class_name="bolt", cad="m8", pose=rigid(turn, np.ones(3)), **found, eye=EYE
        )
        facts = {"candidates": (best,), "points": rng.random((9, 3)), "place": Place(True)}
        facts["edges"] = np.zeros((1, 2, 3), np.float32)
        answers.append(Answer(Path(name), {"bolt": share}, **facts))
    draw_poses(Path(), answers)
    assert [tile.caption.partition("\n")[0] for tile in drawn] == ["lost", "doubtful", "sure"]
    page = Page(parts_page(answers, ("bolt",)))
    assert [a["data-file"] for _, a in page.tags if "data-file" in a] == [
        "lost",
        "doubtful",
        "sure",
    ]
    assert all(tile.camera == pytest.approx(EYE) for tile in drawn)
    assert drawn[0].turn is None
    assert all(tile.turn == pytest.approx(turn) for tile in drawn[1:])


def test_a_sheet_explains_its_colours_if_it_shows_cad(rng):
    points, edges = rng.random((50, 3)), rng.random((4, 2, 3))
    assert scan_sheet([Tile(points, "a")]).legends == []
    figure = scan_sheet([Tile(points, "a", edges, np.array([0, 0, 5.0]), turn=np.eye(3))])
    (legend,) = figure.legends
    texts = ["scan", "edges of CAD", "edges of CAD, lost: pose not believed", "x y z: axes of CAD"]
    assert [text.get_text() for text in legend.get_texts()] == texts
    FigureCanvasAgg(figure).draw()
    boxes = [legend.get_window_extent(), *(axes.get_tightbbox() for axes in figure.axes)]
    assert boxes[0].count_overlaps(boxes[1:]) == 0
    assert figure.bbox.x0 <= boxes[0].x0 < boxes[0].x1 <= figure.bbox.x1
    letters = {text.get_text(): text.get_window_extent() for text in figure.axes[0].texts}
    x, y, z = (letters[name] for name in "xyz")  # seen from above
    assert (x.x0 > z.x0, abs(x.y0 - z.y0) < 4, y.y0 > z.y0) == (True, True, True)


def test_many_scans_take_several_pages(rng, tmp_path):
    tiles = [Tile(rng.random((9, 3)), str(i)) for i in range(61)]
    pages = write_sheets(tmp_path / "labels.png", tiles)
    assert [page.name for page in pages] == ["labels.png", "labels-2.png", "labels-3.png"]
    for page in pages:
        with Image.open(page) as picture:
            picture.verify()


def test_pages_leave_a_picture_of_another_command(rng, tmp_path):
    other = tmp_path / "labels-2.png"
    write_png(other, Figure(figsize=(1, 1)))
    before = other.read_bytes()
    with pytest.raises(InputError, match=r"labels-2\.png: is no such picture of qs3; move it"):
        write_sheets(tmp_path / "labels.png", [Tile(rng.random((9, 3)), "a")])
    assert other.read_bytes() == before
