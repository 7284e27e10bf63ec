"""Parts that are larger or smaller than their CAD: one scale per class, over all of its scans."""

import csv
import json
import re
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh
from trimesh.creation import annulus, box, cylinder

from qs3.errors import InputError
from qs3.evaluation.poses import mssd
from qs3.frames.intrinsics import Intrinsics
from qs3.parts import Library, Place, find, locate, locate_all
from qs3.parts.deviation import Look, _clear, lines_of, settle
from qs3.parts.locating import Location, compare, located, scan_of
from qs3.parts.scenes.find_files import FrameAnswer, answers_csv, part_record
from qs3.parts.scenes.frames import FramePath

from ..objects.depth_scene import looking_down, photograph
from .test_locate import part_of

MATRIX, SHAPE = np.array([[520.0, 0, 159.5], [0, 520.0, 119.5], [0, 0, 1]]), (240, 320)


def at(mesh: trimesh.Trimesh, x: float = 0, y: float = 0, z: float = 0) -> trimesh.Trimesh:
    return mesh.apply_translation((x, y, z))


PIECES = {
    "block": [at(box((0.06, 0.03, 0.01)), z=0.005), at(box((0.01, 0.03, 0.04)), 0.025, z=0.02),
              at(box((0.02, 0.008, 0.02)), -0.02, 0.011, 0.012)],
    "bolt": [at(cylinder(0.015, 0.012, sections=6), z=0.006), at(cylinder(0.008, 0.05), z=0.025)],
    "nut": [at(annulus(0.009, 0.0185, 0.016, sections=6), z=0.008)],
    "large nut": [at(annulus(0.0095, 0.0198, 0.0165, sections=6), z=0.00825)],
}  # fmt: skip
"""They stand on z = 0; the nuts differ by a few percent."""
MESHES: dict[str, Any] = {name: trimesh.util.concatenate(pieces) for name, pieces in PIECES.items()}


def seen(whole: Any, scale: float, seed: int) -> tuple[np.ndarray, Place, np.ndarray]:
    """Return a scan of a scaled part on a table, what is known of its place, and its pose."""
    rng = np.random.default_rng([seed, len(whole.vertices)])
    pose = trimesh.transformations.rotation_matrix(rng.uniform(0, 7), (0, 0, 1))
    pose[:2, 3] = rng.uniform(-0.02, 0.02, 2)
    turn, down = rng.uniform(0, 7), np.radians(rng.uniform(35, 65))
    ahead = np.array([np.cos(turn) * np.cos(down), np.sin(turn) * np.cos(down), -np.sin(down)])
    right = np.array([ahead[1], -ahead[0], 0]) / np.cos(down)
    camera = np.eye(4)
    camera[:3, :3] = np.stack([right, np.cross(ahead, right), ahead], axis=1)
    camera[:3, 3] = (0, 0, 0.02) - rng.uniform(0.35, 0.5) * ahead
    mesh = whole.copy().apply_scale(scale).apply_transform(pose)
    depth, _ = photograph(mesh, camera, MATRIX, SHAPE)
    v, u = np.nonzero(depth)
    z = depth[v, u] + rng.normal(0, 0.0004, len(v))
    points = np.stack([(u - 159.5) / 520 * z, (v - 119.5) / 520 * z, z], axis=1)
    points = points @ camera[:3, :3].T + camera[:3, 3]
    x, y, height = camera[:3, 3].tolist()
    return points[points[:, 2] > 0.003], Place(True, (x, y, height)), pose


@cache
def cad() -> Library:
    return Library(tuple(part_of(mesh, name) for name, mesh in MESHES.items()))


class Bench:
    """Scans of parts of known scales, answered at the size of their CAD and with a tolerance."""

    def __init__(self, scales: dict[str, float], tolerance: float = 0.1, count: int = 4) -> None:
        self.truth = [(name, scale, *seen(MESHES[name], scale, seed))
                      for name, scale in scales.items() for seed in range(count)]  # fmt: skip
        self.clouds, self.places = zip(*(row[2:4] for row in self.truth), strict=True)
        self.answers, self.library = locate_all(cad(), self.clouds, tolerance, self.places)

    def plain(self) -> list[Location]:
        pairs = zip(self.clouds, self.places, strict=True)
        return [locate(cad(), cloud, place) for cloud, place in pairs]

    def right(self, answers: list[Location]) -> np.ndarray:
        """Return which scans have the right class, and a pose that is off by 2 mm at most."""
        hits = []
        for (name, scale, _, _, pose), location in zip(self.truth, answers, strict=True):
            best = location.best
            assert best is not None
            true_part = next(part for part in cad() if part.cad == name).scaled(scale)
            found = best.pose @ np.diag([best.scale / scale] * 3 + [1.0])
            off = mssd(
                found, pose, true_part.points.astype(np.float64), true_part.symmetry.equals()
            )
            hits.append(best.class_name == name and not best.lost and off < 2e-3)
        return np.array(hits)


def test_scales_of_all_classes_are_found_and_classes_and_poses_are_right() -> None:
    """At the size of the CAD a nut looks like the large nut, and the large nut like none."""
    scales = {"nut": 1.06, "large nut": 1.06}
    bench = Bench(scales, count=3)
    assert {*bench.library.scales} == {*scales}
    for name, scale in scales.items():
        assert bench.library.scales[name] == pytest.approx(scale, rel=0.01)
    assert not bench.library.beyond
    assert bench.right(bench.plain()).mean() < 0.3
    assert bench.right(bench.answers).mean() >= 0.9
    for row, location in zip(bench.truth, bench.answers, strict=True):
        best = location.best
        assert best is not None
        assert best.scale == bench.library.scales[best.class_name]
        if best.class_name == row[0]:  # the scaled part lies on the table
            vertices = MESHES[row[0]].vertices * best.scale
            low = (vertices @ best.pose[:3, :3].T + best.pose[:3, 3])[:, 2].min()
            assert low == pytest.approx(0, abs=0.0015)


@cache
def looks_at_bolts(scales: tuple[tuple[str, float], ...]) -> list[Look]:
    """Compare four scans of small bolts with the CAD at some scales."""
    scaled, looks = cad().scaled(dict(scales)), []
    for seed in range(4):
        cloud, place, _ = seen(MESHES["bolt"], 0.93, seed)
        scan = scan_of(cloud, place)
        looks.append(Look(scan, place, located(compare(scaled, scan, place)).candidates))
    return looks


@pytest.mark.parametrize(("lost", "scaled"), [(1, {"bolt"}), (2, {"bolt"}), (3, set())])
def test_a_scale_that_leaves_most_of_its_scans_lost_is_not_believed(
    lost: int, scaled: set[str]
) -> None:
    tried = list[dict[str, float]]()

    def answer(known: Library) -> list[Look]:
        tried.append(dict(known.scales))
        return [look._replace(candidates=tuple(replace(one, lost=row < lost) for one in found))
                for row, look in enumerate(looks_at_bolts((*known.scales.items(),)))
                for found in [look.candidates]]  # fmt: skip

    library, found = settle(cad(), answer, 0.1)
    assert {*library.scales} == scaled
    assert found["bolt"].doubted == (not scaled)
    assert ("keeps its size" in lines_of(found, 0.1)[0]) == (not scaled)
    assert tried[1]["bolt"] == pytest.approx(0.93, rel=0.01)  # it was tried
    assert tried[-1] == library.scales


def test_noise_scales_no_class_of_parts_that_are_as_their_cad() -> None:
    bench = Bench({"nut": 1.0, "large nut": 1.0}, count=3)
    assert bench.library.scales == {}
    assert not bench.library.beyond
    for one, other in zip(bench.answers, bench.plain(), strict=True):
        assert one.best is not None and other.best is not None
        assert one.best.pose.tobytes() == other.best.pose.tobytes()
        assert (one.best.cad, one.best.misfit, one.lost) == (
            other.best.cad, other.best.misfit, other.lost,
        )  # fmt: skip


def test_a_shrunken_class_explains_no_scans_of_another_one() -> None:
    """A nut 1.07 times its size would be a large nut."""
    bench = Bench({"large nut": 1.0}, count=6)
    assert bench.library.scales == {}
    assert bench.right(bench.answers).all()


@pytest.mark.parametrize("noise", [0.05, 0.15])
@pytest.mark.parametrize("width", [0.03, 0.06, 0.12])
def test_noise_gives_a_rival_of_another_size_no_scans(noise: float, width: float) -> None:
    """A rival that is 0.95 times its size explains each scan as well, but for noise."""
    scales = np.arange(-6, 7) * 0.025
    for seed in range(20):
        rng = np.random.default_rng(seed)
        misfits = [
            np.exp(rng.normal(0, noise, (16, 1))) * (1 + ((scales - best) / width) ** 2)
            for best in (0.0, -0.05, 0.2)
        ]
        table = np.log1p(np.stack(misfits) * (1 + rng.normal(0, 0.05, (3, 16, len(scales)))))
        assert _clear(table).tolist() == [6, 6, 6]


def test_parts_beyond_the_tolerance_are_lost() -> None:
    bench = Bench({"block": 1.2, "bolt": 0.8}, count=3)
    assert bench.library.beyond == {"block", "bolt"}
    assert bench.library.scales == {}
    assert all(location.lost for location in bench.answers)
    narrow = Bench({"bolt": 0.93}, tolerance=0.03, count=3)
    assert narrow.library.beyond == {"bolt"}
    assert all(location.lost for location in narrow.answers)


def test_the_parts_of_a_picture_have_the_scale_of_their_library() -> None:
    mesh = MESHES["block"].copy().apply_scale(1.06)
    table = at(box((0.8, 0.8, 0.02)), z=-0.01)
    camera = looking_down(55.0, (0.0, -0.3, 0.43))
    depth, _ = photograph(trimesh.util.concatenate([table, mesh]), camera, MATRIX, SHAPE)
    frame = Intrinsics(520.0, 520.0, 159.5, 119.5)
    found = find(cad().scaled({"block": 1.06}), depth, frame)
    (part,) = found.parts
    assert (part.cad, part.scale) == ("block", 1.06)
    placed = trimesh.transform_points(part.scale * MESHES["block"].vertices, part.pose)
    true = trimesh.transform_points(mesh.vertices, np.linalg.inv(camera))
    assert np.abs(true - placed).max() < 2e-3
    assert part_record(part)["scale"] == 1.06
    text = answers_csv([FrameAnswer(FramePath("0", Path("0.png"), frame), found)])
    (row,) = [row for row in csv.DictReader(text.splitlines()) if row["cad"]]
    assert row["scale"] == "1.06"
    beyond = find(cad().scaled({"block": 1.06}, {"block"}), depth, frame)
    assert not beyond.parts
    assert len(beyond.unexplained) == 1


def test_two_scans_measure_no_scale() -> None:
    assert Bench({"bolt": 0.93}, count=2).library.scales == {}


def test_all_files_of_a_class_share_its_scale() -> None:
    mixed = Library(tuple(part_of(MESHES[name], name) for name in ("block", "bolt")))
    mixed = Library(tuple(replace(part, class_name="part") for part in mixed))
    rows = [seen(MESHES[name], 0.93, seed) for name in ("block", "bolt") for seed in range(2)]
    clouds, places, _ = zip(*rows, strict=True)
    found, library = locate_all(mixed, clouds, 0.1, places)
    assert library.scales == {"part": pytest.approx(0.93, rel=0.01)}
    assert [one.best.cad for one in found if one.best] == ["block"] * 2 + ["bolt"] * 2
    assert {one.best.scale for one in found if one.best} == {library.scales["part"]}


def test_a_scaled_part_is_scaled_in_all_it_has() -> None:
    part = part_of(MESHES["bolt"])
    large, mesh = part.scaled(1.2), MESHES["bolt"].copy().apply_scale(1.2)
    direct = part_of(mesh)
    assert large.diameter == pytest.approx(direct.diameter, rel=1e-3)
    assert large.spacing == pytest.approx(direct.spacing, rel=1e-6)
    assert large.middle == pytest.approx(direct.middle, abs=1e-4)
    assert large.symmetry.middle == pytest.approx(1.2 * part.symmetry.middle)
    assert large.lain[1] == pytest.approx(1.2 * part.lain[1], rel=1e-5)
    assert large.scaled(1.0) is part
    assert large.scaled(0.9).points.tobytes() == part.scaled(0.9).points.tobytes()


def test_a_library_keeps_its_scales(tmp_path: Path) -> None:
    path, plain = tmp_path / "library.safetensors", tmp_path / "plain.safetensors"
    cad().save(plain)
    scaled = cad().scaled({"bolt": 0.93}, {"nut"})
    scaled.save(path)
    read = Library.read(path)
    assert (read.scales, read.beyond) == ({"bolt": 0.93}, {"nut"})
    for one, other in zip(read, scaled, strict=True):
        assert one.points.tobytes() == other.points.tobytes()
    read.scaled({}).save(path)
    assert path.read_bytes() == plain.read_bytes()
    for scales, beyond in (({"bolt": 3.0}, ()), ({"bolt": float("nan")}, ())):
        with pytest.raises((InputError, ValueError)):
            cad().scaled(scales, beyond).save(path)
            Library.read(path)


@pytest.mark.parametrize("tolerance", [-0.1, 0.25, 2.0, float("nan"), float("inf")])
def test_a_tolerance_out_of_range_is_refused(tolerance: float) -> None:
    with pytest.raises(InputError, match=r"must be at least 0 and less than 0\.25") as caught:
        locate_all(cad(), [], tolerance)
    assert "\n" not in str(caught.value)


def test_the_command_names_the_scale_and_the_pose_belongs_to_the_scaled_file(
    tmp_path: Path, typed
) -> None:
    """The file is in millimetres, its origin far off; another program loads and scales it."""
    for folder in ("cad", "scans"):
        (tmp_path / folder).mkdir()
    for name in ("block", "bolt"):
        mesh = at(MESHES[name].copy().apply_scale(1000), 200, -50, 30)
        mesh.export(tmp_path / "cad" / f"{name}.stl")
    rows = {seed: seen(MESHES["block"], 1.06, seed) for seed in range(3)}
    for seed, (points, _, _) in rows.items():
        np.save(tmp_path / "scans" / f"{seed}.npy", points)
    out, table = tmp_path / "found.json", tmp_path / "found.csv"
    done = typed("locate", tmp_path / "cad", tmp_path / "scans", "--units", "mm", "--on-table",
                 "--tolerance", 0.1, "--json", out, "--csv", table)  # fmt: skip
    assert re.search(r"^block: 1\.0[567]\d* times its CAD \(3 scans\)$", done.stderr, re.M)
    loaded = np.asarray(trimesh.load(tmp_path / "cad" / "block.stl", force="mesh").vertices) / 1000
    with table.open() as file:
        cells = {Path(row["file"]).stem: row for row in csv.DictReader(file)}
    for row in json.loads(out.read_text()):
        assert (row["class"], row["lost"]) == ("block", False)
        assert row["scale"] == pytest.approx(1.06, rel=0.01)
        name, pose = Path(row["file"]).stem, np.array(row["pose"])
        placed = (row["scale"] * loaded) @ pose[:3, :3].T + pose[:3, 3]
        true = trimesh.transform_points(
            1.06 * (loaded - np.array((0.2, -0.05, 0.03))), rows[int(name)][2]
        )
        assert np.abs(placed - true).max() < 2e-3
        assert float(cells[name]["scale"]) == row["scale"]
    plain = typed("locate", tmp_path / "cad", tmp_path / "scans" / "0.npy", "--units", "mm",
                  "--on-table", "--json", "-")  # fmt: skip
    assert "scale" not in plain.stdout
    assert "times its CAD" not in plain.stderr
