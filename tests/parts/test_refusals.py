"""What is no scan of a known part is refused in one line, or is lost: never a sure wrong pose."""

import inspect
from collections.abc import Callable
from functools import cache
from itertools import product
from pathlib import Path

import numpy as np
import pytest
import trimesh

from qs3 import shapes
from qs3.errors import InputError
from qs3.evaluation.poses import adds, mssd, turned_by
from qs3.geometry import transform_points
from qs3.meshes import collect
from qs3.parts import Library, Place, locate
from qs3.parts.cad import keep_cad, read_cad
from qs3.parts.locating import scan_of
from qs3.parts.twins import note_twins
from qs3.workflow.training import Cad

from .test_locate import BRACKET, CAMERA, any_pose, part_of, seen_from_origin

AHEAD = np.array([0.0, 0.0, 0.5])


def noisy(points: np.ndarray, seed: int) -> np.ndarray:
    """Return points with half a millimetre of noise."""
    return points + np.random.default_rng(seed).normal(0, 0.0005, points.shape)


def seen(mesh: trimesh.Trimesh, seed: int = 1) -> np.ndarray:
    """Return a scan of another thing."""
    return noisy(seen_from_origin(part_of(mesh), any_pose(seed)), seed)


def sheet(wide: float, high: float, count: int = 2500, seed: int = 0) -> np.ndarray:
    spread = np.random.default_rng(seed).random((count, 3)) * (wide, high, 0.0005)
    return spread - (wide / 2, high / 2, 0) + AHEAD


@pytest.mark.parametrize("read", [Library.of_folder, lambda cad: Cad(cad).read(("Lost", "rod"))])
def test_a_class_is_called_by_no_word_of_the_answers(
    read: Callable[[Path], object], tmp_path: Path
) -> None:
    for name in ("Lost", "rod"):
        trimesh.creation.box((0.06, 0.04, 0.02)).export(tmp_path / f"{name}.stl")
    with pytest.raises(
        InputError, match=f"{tmp_path}: class Lost of Lost is a word of the answers"
    ):
        read(tmp_path)


@cache
def cad() -> Library:
    return Library((part_of(BRACKET, "bracket"), part_of(PIN, "pin")))


@cache
def good() -> np.ndarray:
    return noisy(seen_from_origin(cad().parts[0], any_pose(1)), 0)


def beside(*scans: np.ndarray, step: float = 0.05) -> np.ndarray:
    return np.concatenate([scan + np.array((step * k, 0, 0)) for k, scan in enumerate(scans)])


def scaled(factor: float) -> np.ndarray:
    middle = good().mean(axis=0)
    return (good() - middle) * factor + middle


def with_other(scan: np.ndarray, other: np.ndarray, *step: float) -> np.ndarray:
    return np.concatenate([scan, other + np.array(step)])


PIN = trimesh.creation.cylinder(0.012, 0.07)
NUT = trimesh.creation.annulus(0.009, 0.017, 0.014, sections=6)
CORNER = sheet(0.08, 0.08, seed=1)[:, [2, 1, 0]]
LOST: dict[str, Callable[[], np.ndarray]] = {
    "wall": lambda: sheet(0.07, 0.07),
    "large wall": lambda: sheet(0.6, 0.4),
    "corner of a room": lambda: with_other(sheet(0.08, 0.08), CORNER, -0.5, 0, 0.5),
    "two brackets": lambda: beside(good(), good()),
    "six brackets": lambda: beside(*[good()] * 6),
    "bracket and pin": lambda: with_other(good(), seen(PIN, 4), 0.05, 0, 0),
    "part and its table": lambda: with_other(good(), sheet(0.3, 0.3, 6000), 0, 0, 0.03),
    "part and a patch of table": lambda: with_other(good(), sheet(0.12, 0.12), 0, 0, 0.03),
    "ball": lambda: seen(trimesh.creation.icosphere(3, 0.03)),
    "cube": lambda: seen(trimesh.creation.box((0.05, 0.05, 0.05))),
    "long rod": lambda: seen(trimesh.creation.cylinder(0.004, 0.12)),
    "ring": lambda: seen(trimesh.creation.annulus(0.02, 0.035, 0.01)),
    "cone": lambda: seen(trimesh.creation.cone(0.025, 0.06)),
    "noise in a box": lambda: np.random.default_rng(2).random((800, 3)) * 0.06 + AHEAD,
    "noise in a ball": lambda: 0.03 * np.random.default_rng(3).normal(size=(800, 3)) + AHEAD,
    "nut": lambda: seen(NUT),
    "bracket a third larger": lambda: scaled(1.34),
    "bracket half as large again": lambda: scaled(1.5),
    "bracket of two thirds": lambda: scaled(0.66),
    "bracket of twice the size": lambda: scaled(2.0),
    "wire": lambda: noisy(sheet(0.04, 0.0, 200) * (1, 1, 0) + AHEAD, 0),
    "spot of a wall": lambda: sheet(0.02, 0.02),
    "thirteen points of a room": lambda: np.random.default_rng(13).random((13, 3)) * 0.05 + AHEAD,
}
SEEN = "wall", "bracket and pin", "part and its table", "ball", "nut", "bracket a third larger"
REFUSED: dict[str, tuple[Callable[[], np.ndarray], Place, str]] = {
    "six points": (lambda: good()[:6], CAMERA, "6 distinct points"),
    "one point a thousand times": (lambda: np.tile(good()[:1], (1000, 1)), CAMERA, "1 distinct"),
    "a line": (lambda: sheet(0.05, 0.0) * (1, 1, 0) + AHEAD, CAMERA, "lie on one line"),
    "no point": (lambda: good()[:0], CAMERA, "0 distinct points"),
    "millimetres": (lambda: 1000 * good(), CAMERA, "divide millimetres by 1000"),
    "a building": (lambda: 500 * good(), CAMERA, "must be in metres"),
    "camera below the table": (lambda: good(), Place(True, (0.0, 0.0, -0.3)), "below the table"),
    "map coordinates": (lambda: good() + np.array((5e5, 4.6e6, 0)), CAMERA, "4,627,094 m from"),
    "a planet": (lambda: 1e30 * good(), CAMERA, "over 1,000 km apart"),
    "four columns": (lambda: good()[:, [0, 1, 2, 0]], CAMERA, r"give metres of shape \[n, 3\]"),
    "a batch": (lambda: good()[None], CAMERA, r"give metres of shape \[n, 3\]"),
    "words": (lambda: good().astype(str), CAMERA, r"give metres of shape \[n, 3\]"),
    "not a number": (lambda: np.where(good() > 0, good(), np.nan), CAMERA, "not finite"),
    "infinite": (lambda: np.where(np.arange(len(good()))[:, None] == 3, np.inf, good()), CAMERA,
                 "not finite"),
}  # fmt: skip


def test_the_part_itself_is_found() -> None:
    best = locate(cad(), good(), CAMERA).best
    assert best is not None
    assert (best.class_name, best.lost) == ("bracket", False)


def test_a_place_of_another_type_is_refused() -> None:
    with pytest.raises(InputError, match=r"place 'table': give a qs3\.parts\.Place"):
        inspect.unwrap(scan_of)(LOST[next(iter(LOST))](), "table")


@pytest.mark.parametrize(
    ("name", "place"), [*((name, Place()) for name in LOST), *((name, CAMERA) for name in SEEN)]
)
def test_other_things_are_lost(name: str, place: Place) -> None:
    found = locate(cad(), LOST[name](), place)
    assert found.lost and found.pose is None


@pytest.mark.parametrize("place", [CAMERA, Place()], ids=["camera", "nothing known"])
@pytest.mark.parametrize("name", ["wire", "spot of a wall", "thirteen points of a room"])
def test_what_shows_no_part_is_lost_beside_one_cad_file(name: str, place: Place) -> None:
    """No rival speaks against it."""
    for part in cad():
        assert locate(Library((part,)), LOST[name](), place).lost


def test_what_shows_less_than_half_of_a_part_is_lost_however_long_it_is() -> None:
    along = good() @ np.linalg.svd(good() - good().mean(axis=0), full_matrices=False)[2][0]
    low, high = np.quantile(along, [0.2, 0.8])
    best = locate(Library(cad().parts[:1]), good()[(along < low) | (along > high)], CAMERA).best
    assert best is not None
    assert best.span > 0.9 and np.isfinite(best.disagreement)
    assert best.visible < 0.5 and best.lost


def test_a_rod_that_stands_on_a_table_is_found_from_above() -> None:
    """Without the table nothing shows how long it is."""
    part = part_of(trimesh.creation.cylinder(0.008, 0.08), "rod")
    pose = trimesh.transformations.translation_matrix((0, 0, 0.04))
    scan = transform_points(pose, part.points[part.normals[:, 2] > 0.9].astype(np.float64))
    scan = noisy(scan[scan[:, 2] > 0.079], 0)
    known = Place(True, (0.0, 0.0, 0.6))
    found = locate(Library((part,)), scan, known)
    assert found.pose is not None
    assert adds(found.pose, pose, part.points) < 0.002
    assert locate(Library((part,)), scan).lost


@pytest.mark.parametrize("size", [0.015, 0.018])
def test_noise_as_wide_as_the_part_is_lost_whatever_the_limit_of_a_run(size: float) -> None:
    """Behind a noisy camera known parts disagree twenty times as much as such a cloud may."""
    cloud = size * np.random.default_rng(3).normal(size=(800, 3)) + AHEAD
    best = locate(cad(), cloud, CAMERA).best
    assert best is not None
    assert np.isinf(best.disagreement)


@pytest.mark.parametrize("name", REFUSED)
def test_no_scans_are_refused_in_a_line(name: str) -> None:
    make, place, message = REFUSED[name]
    with pytest.raises(InputError, match=message) as caught:
        locate(cad(), make(), place)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("name", ["point", "line", "empty", "tiny"])
def test_cad_that_cannot_be_used_is_named(tmp_path: Path, name: str) -> None:
    faces = {"point": "v 0 0 0\nv 0 0 0\nv 0 0 0\nf 1 2 3\n",
             "line": "v 0 0 0\nv 1 0 0\nv 2 0 0\nf 1 2 3\n", "empty": "",
             "tiny": "v 0 0 0\nv 1e-5 0 0\nv 0 1e-5 0\nf 1 2 3\n"}  # fmt: skip
    (tmp_path / f"{name}.obj").write_text(faces[name])
    with pytest.raises(InputError, match=f"{name}.obj"):
        Library.of_folder(tmp_path, "m")


def test_cad_of_which_some_is_taken_for_metres_is_refused(tmp_path: Path) -> None:
    for name, side in (("pad", 40.0), ("ball", 4.0)):
        trimesh.creation.box((side, side / 2, side / 4)).export(tmp_path / f"{name}.stl")
    message = "ball would be taken for metres and pad for millimetres.*: --units mm, say"
    reads: list[Callable[[Path], object]] = [
        Library.of_folder,
        lambda cad: Cad(cad).read(("ball", "pad")),
    ]
    for read in reads:
        with pytest.raises(InputError, match=f"^{tmp_path}: {message}"):
            read(tmp_path)
    with pytest.raises(InputError, match=f"^{message}"):
        keep_cad(tmp_path / "kept", collect(tmp_path), ("ball", "pad"), None)
    assert not (tmp_path / "kept").exists()
    assert len(read_cad(collect(tmp_path), ("ball",)).library.parts) == 1
    assert Library.of_folder(tmp_path, "mm").largest < 0.05


PLATE = trimesh.util.concatenate(
    [
        trimesh.creation.box((0.06, 0.02, 0.001)),
        trimesh.creation.box((0.02, 0.03, 0.001)).apply_translation((-0.02, 0.025, 0)),
        trimesh.creation.box((0.014, 0.001, 0.006)).apply_translation((0.02, 0.005, 0.003)),
    ]
)
"""Sheet metal, one millimetre thick: from behind it is its mirror image, without the lug."""


@pytest.mark.parametrize("behind", [False, True], ids=["front", "back"])
@pytest.mark.parametrize("place", [CAMERA, Place()], ids=["camera", "nothing known"])
def test_the_front_of_a_sheet_is_not_its_back(behind: bool, place: Place) -> None:
    part = part_of(PLATE)
    pose = trimesh.transformations.euler_matrix(np.pi * (not behind) + 0.4, 0.3, 0.7)
    pose[:3, 3] = AHEAD
    best = locate(Library((part,)), noisy(seen_from_origin(part, pose), 0), place).best
    assert best is not None
    assert not best.lost
    assert turned_by(best.pose, pose) < 5


def hexagon(flats: float, high: float, bore: float) -> trimesh.Trimesh:
    return trimesh.creation.annulus(bore / 2, flats / 3**0.5, high, sections=6)


def test_the_size_of_a_nut_and_the_side_of_a_sheet_are_told_apart() -> None:
    """Turned by the symmetry of the nut, and seen from the side where a sheet has no rib."""
    nuts = [part_of(hexagon(0.001 * flats, 0.0008 * flats, 0.0006 * flats), f"nut {flats}")
            for flats in (24, 30, 36)]  # fmt: skip
    for seed, nut in enumerate(nuts):
        pose = any_pose(seed)
        best = locate(Library((*nuts,)), seen_from_origin(nut, pose), CAMERA).best
        assert best is not None
        assert best.class_name == nut.class_name
        assert not best.lost
        assert mssd(best.pose, pose, nut.points.astype(float), nut.symmetry.equals()) < 2e-3
    plate, rib = (
        trimesh.creation.box((0.08, 0.05, 0.002)),
        trimesh.creation.box((0.03, 0.004, 0.006)),
    )
    sheet_metal = trimesh.util.concatenate([plate, rib.apply_translation((0.02, 0.015, 0.003))])
    mirrored = sheet_metal.copy().apply_transform(np.diag([1, -1, 1, 1]))
    mirrored.invert()
    both = part_of(sheet_metal, "left"), part_of(mirrored, "right")
    for part in both:
        pose = trimesh.transformations.rotation_matrix(2.8, (1, 0.2, 0))  # the rib is seen
        pose[:3, 3] = (0, 0, 0.5)
        best = locate(Library(both), seen_from_origin(part, pose), CAMERA).best
        assert best is not None
        assert best.class_name == part.class_name
        assert adds(best.pose, pose, part.points) < 1e-3


def test_meshing_noise_of_the_cad_does_no_harm() -> None:
    mesh = BRACKET.subdivide().subdivide().subdivide()
    index = np.unique(mesh.vertices, axis=0, return_inverse=True)[1].ravel()
    shaken = np.random.default_rng(0).normal(0, 0.0002, (index.max() + 1, 3))[index]
    part = part_of(trimesh.Trimesh(mesh.vertices + shaken, mesh.faces, process=False))
    for seed in range(3):
        scan = noisy(seen_from_origin(cad().parts[0], any_pose(seed)), seed)
        best = locate(Library((part,)), scan, CAMERA).best
        assert best is not None
        assert not best.lost
        assert turned_by(best.pose, any_pose(seed)) < 3


def test_parts_at_the_border_of_the_picture_are_found_or_lost() -> None:
    """Of twelve at most one has a sure pose that is wrong."""
    wrong, found = [], 0
    for seed, share in product(range(4), (0.75, 0.5, 0.3)):
        pose = any_pose(seed)
        scan = noisy(seen_from_origin(cad().parts[0], pose), seed)
        scan = scan[scan[:, 0] < np.quantile(scan[:, 0], share)]
        best = locate(cad(), scan, CAMERA).best
        assert best is not None
        right = best.cad == "bracket" and adds(best.pose, pose, cad().parts[0].points) < 0.005
        found += right and not best.lost
        wrong += [] if best.lost or right else [(seed, share)]
    assert found >= 4
    assert len(wrong) <= 1, wrong


def test_scraps_of_known_parts_are_right_or_lost() -> None:
    """A tenth of the scan: of the right, above, or about a point."""
    names = "bolt", "bracket", "elbow", "lever"
    parts = tuple(part_of(shapes.make(name, seed=0), name) for name in names)
    wrong = []
    for part in parts:
        scan = noisy(seen_from_origin(part, any_pose(1)), 1)
        whole = locate(Library(parts), scan)
        assert whole.best is not None
        assert (whole.best.cad, whole.lost) == (part.cad, False)
        for side in (scan[:, 0], scan[:, 1], np.linalg.norm(scan - scan[7], axis=1)):
            found = locate(Library(parts), scan[side <= np.quantile(side, 0.1)])
            assert found.best is not None
            if not found.lost and found.best.cad != part.cad:
                wrong.append((part.cad, found.best.cad))
    assert wrong == []


def angle(wide: float, high: float, thick: float) -> trimesh.Trimesh:
    foot = trimesh.creation.box((wide, 0.03, thick))
    back = trimesh.creation.box((thick, 0.03, high))
    back.apply_translation(((wide - thick) / 2, 0, (high - thick) / 2))
    return trimesh.util.concatenate([foot, back])


def test_a_part_whose_file_is_missing_is_lost_among_similar_parts() -> None:
    """Most are; known parts among them are not lost."""
    box = trimesh.creation.box
    meshes = {"plate": box((0.06, 0.06, 0.004)), "long plate": box((0.08, 0.04, 0.004)),
              "brick": box((0.04, 0.048, 0.06)), "angle": angle(0.05, 0.05, 0.004),
              "long angle": angle(0.07, 0.035, 0.005), "bracket": BRACKET}  # fmt: skip
    parts = [part_of(mesh, name) for name, mesh in meshes.items()]
    known, missing = [], []
    for seed, part in enumerate(parts):
        scan = noisy(seen_from_origin(part, any_pose(seed)), seed)
        others = tuple(other for other in parts if other is not part)
        found = locate(Library(tuple(parts)), scan, CAMERA)
        assert found.best is not None
        assert found.best.cad == part.cad
        known.append(found.lost)
        missing.append(locate(Library(others), scan, CAMERA).lost)
    assert sum(known) == 0
    assert sum(missing) >= 5


def test_open_and_flat_cad_is_found() -> None:
    cap = trimesh.creation.uv_sphere(0.03, count=(32, 64))
    cap.update_faces(cap.triangles_center[:, 2] > 0.005)
    plate = trimesh.Trimesh([[0, 0, 0], [0.06, 0, 0], [0.06, 0.03, 0], [0, 0.05, 0]],
                            [[0, 1, 2], [0, 2, 3]])  # fmt: skip
    pose = any_pose(2)
    for part in (part_of(cap), part_of(plate)):
        best = locate(Library((part,)), seen_from_origin(part, pose), CAMERA).best
        assert best is not None
        assert adds(best.pose, pose, part.points) < 1e-3


def test_two_classes_of_nearly_one_shape_are_named_and_mirror_images_are_not(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    turned = BRACKET.copy().apply_transform(any_pose(3))
    others = {
        "turned": (turned, "nearly the same shape, and scans hardly tell bracket"),
        "larger": (BRACKET.copy().apply_scale(1.001), "bracket and larger have nearly"),
        "mirrored": (BRACKET.copy().apply_transform(np.diag([-1, 1, 1, 1])), ""),
        "copy": (BRACKET, "bracket and copy have the same shape, and no scan can tell"),
    }
    for name, (mesh, warning) in others.items():
        folder = tmp_path / name
        folder.mkdir()
        BRACKET.export(folder / "bracket.stl")
        mesh.export(folder / f"{name}.stl")
        caplog.clear()
        note_twins(Library.of_folder(folder, "m").parts)
        assert warning in caplog.text
        assert ("have" in caplog.text) == bool(warning)


def test_blocks_of_one_area_whose_lengths_differ_by_3_mm_are_no_twins(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    for name, size in (("long", (0.0535, 0.03, 0.0179)), ("thick", (0.05, 0.03, 0.02))):
        trimesh.creation.box(size).export(tmp_path / f"{name}.stl")
    note_twins(Library.of_folder(tmp_path, "m").parts)
    assert "same shape" not in caplog.text


def test_wires_that_no_camera_sees_as_surfaces_cost_no_library(tmp_path: Path) -> None:
    for name, length in (("short", 1.2), ("long", 1.21)):
        trimesh.creation.cylinder(0.0004, length, sections=12).export(tmp_path / f"{name}.stl")
    library = Library.of_folder(tmp_path, "m")
    note_twins(library.parts)
    assert library.class_names == ("long", "short")
