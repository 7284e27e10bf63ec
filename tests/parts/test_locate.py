"""Known parts are found in scans: class, file and pose."""

import json
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from qs3 import shapes
from qs3.errors import TOLD, InputError
from qs3.evaluation.poses import adds, mssd, turned_by
from qs3.files import open_arrays, write_arrays
from qs3.geometry import transform_points
from qs3.meshes.collections import collect
from qs3.meshes.simplifying import with_fewer_faces
from qs3.parts import Library, Place, locate
from qs3.parts.cad import sharp_edges
from qs3.parts.library import look_at
from qs3.parts.locate_files import kept_library, library_of
from qs3.parts.resting import resting_directions
from qs3.parts.scan import prepare
from qs3.parts.score import Score, noise_of, score
from qs3.parts.views import Part
from qs3.parts.visible import directions, visible

from ..stores import view_once

BRACKET = trimesh.util.concatenate(
    [
        trimesh.creation.box((0.06, 0.03, 0.005)),
        trimesh.creation.box((0.005, 0.03, 0.05)).apply_translation((0.0275, 0, 0.025)),
        trimesh.creation.box((0.02, 0.008, 0.02)).apply_translation((-0.02, 0.011, 0.012)),
    ]
)
"""It has no symmetry, and its mirror image is another part."""


def part_of(mesh: Any, name: str = "part") -> Part:
    return view_once(mesh, 1.0, name, name)


def any_pose(seed: int) -> np.ndarray:
    turn = trimesh.transformations.random_rotation_matrix(np.random.default_rng(seed).random(3))
    turn[:3, 3] = (0.02, -0.03, 0.5)
    return turn


def seen_from_origin(part: Part, pose: np.ndarray) -> np.ndarray:
    """Return the points that a camera at the origin sees, without noise."""
    eye = np.linalg.inv(pose)[:3, 3]
    rows = visible(part.points, part.spacing, eye, part.middle)
    return transform_points(pose, part.points[rows].astype(np.float64))


def score_at(part: Part, points: np.ndarray, pose: np.ndarray) -> Score:
    """Return the score of a known pose, seen from the origin."""
    scan = prepare(points, np.zeros(3))
    turn, shift, eye = pose[:3, :3].copy(), pose[:3, 3] - scan.centre, -scan.centre
    rows = visible(part.points, part.spacing, turn.T @ (eye - shift), part.middle)
    rows = np.random.default_rng(0).permutation(rows)[:600]
    gap = part.gap(len(rows), 600)
    return score(scan, 300, part.points[rows], part.normals[rows], gap, turn, shift, eye,
                 noise_of(scan))  # fmt: skip


@pytest.mark.parametrize("size", [(0.06, 0.03, 0.02), (0.1, 0.02, 0.02), (0.05, 0.04, 0.03)])
def test_views_of_a_part_that_lies_as_it_falls_are_likely(size: tuple[float, float, float]) -> None:
    """Shares are near those of dropped boxes; a density has the mean 1; no view is impossible."""
    part = part_of(trimesh.creation.box(size))
    share = {
        tuple(down.round()): float(share)
        for down, share in zip(part.resting, part.likely, strict=True)
    }
    assert sum(share.values()) == pytest.approx(1, abs=1e-5)
    x, y, z = (share[way] + share[tuple(-np.array(way))]
               for way in ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)))  # fmt: skip
    assert x < y <= z * 1.01
    odds = np.array([part.odds(way) for way in directions(2000)])
    assert odds.mean() == pytest.approx(1, abs=0.02)
    assert odds.min() > 0.05
    assert part.odds(np.array([0.0, 0.6, 0.8])) > part.odds(np.array([1.0, 0.0, 0.0]))


def test_a_file_that_would_stand_on_its_head_explains_a_scan_less_well() -> None:
    """A disc is as round as the head of a pin, which does not stand on end."""
    disc = part_of(trimesh.creation.cylinder(0.015, 0.006), "disc")
    head = trimesh.creation.cylinder(0.015, 0.006).apply_translation((0, 0, 0.003))
    shaft = trimesh.creation.cylinder(0.006, 0.1).apply_translation((0, 0, -0.05))
    pin = part_of(trimesh.util.concatenate([head, shaft]), "pin")
    pose = trimesh.transformations.rotation_matrix(np.radians(165), [1, 0, 0])
    pose[:3, 3] = 0, 0, 0.5
    scan = seen_from_origin(disc, pose)
    seen = locate(Library((disc, pin)), scan, CAMERA)
    assert seen.best is not None and seen.best.class_name == "disc"
    surprise = {one.class_name: one.surprise for one in seen.candidates}
    assert surprise["pin"] - surprise["disc"] > 0.5


CAMERA = Place(camera=(0.0, 0.0, 0.0))


@pytest.mark.parametrize("name", shapes.PARTS)
def test_own_view_is_found_within_a_millimetre(name: str) -> None:
    part = part_of(shapes.make(name, seed=0), name)
    pose = any_pose(3)
    found = locate(Library((part,)), seen_from_origin(part, pose), CAMERA)
    assert found.best is not None
    assert not found.lost
    assert adds(found.best.pose, pose, part.points) < 1e-3


@pytest.mark.parametrize("off", [4, 8, 12])
@pytest.mark.parametrize("size", [(0.009, 0.121), (0.006, 0.1), (0.02, 0.25)])
def test_a_rod_is_found_that_is_seen_from_its_end(size: tuple[float, float], off: float) -> None:
    """A camera sees the end, and of the receding side the nearest third at most."""
    part = part_of(trimesh.creation.cylinder(*size), "rod")
    for turn in (0.0, 1.3):
        pose = trimesh.transformations.rotation_matrix(np.radians(off), [1, 0, 0])
        pose = trimesh.transformations.rotation_matrix(turn, [0, 0, 1]) @ pose
        pose[2, 3] = 0.6
        scan = seen_from_origin(part, pose)
        scan = scan[scan[:, 2] < scan[:, 2].min() + size[1] / 3]
        found = locate(Library((part,)), scan, CAMERA)
        assert found.best is not None
        axis = found.best.pose[:3, 2] @ pose[:3, 2]
        assert np.degrees(np.arccos(min(abs(axis), 1))) < 5


def test_part_without_symmetry_is_found_within_a_degree() -> None:
    part = part_of(BRACKET)
    for seed in range(4):
        pose = any_pose(seed)
        found = locate(Library((part,)), seen_from_origin(part, pose), CAMERA).best
        assert found is not None
        assert turned_by(found.pose, pose) < 1
        equals = part.symmetry.equals()
        assert mssd(found.pose, pose, part.points.astype(np.float64), equals) < 1e-3


def test_a_real_part_whose_view_shows_half_of_it_is_not_lost(shared_data: Path) -> None:
    views = np.load(shared_data / "poses" / "bunny_views.npz")
    bunny = part_of(trimesh.load(shared_data / "poses" / "bunny.ply"))
    for view in (0, 11, 19, 28):
        points = views["points"][views["offset"][view] : views["offset"][view + 1]]
        found = locate(Library((bunny,)), points.astype(np.float64))
        assert found.pose is not None
        assert turned_by(found.pose, views["pose"][view]) < 10


@pytest.mark.parametrize("share", [1.0, 0.75, 0.5, 0.25])
def test_visible_is_the_share_of_the_picture_that_the_scan_covers(share: float) -> None:
    part = part_of(BRACKET)
    for seed in range(3):
        scan = seen_from_origin(part, any_pose(seed))
        noisy = scan + np.random.default_rng(seed).normal(0, 0.0005, scan.shape)
        noisy = noisy[scan[:, 0] <= np.quantile(scan[:, 0], share)]
        found = score_at(part, noisy, any_pose(seed))
        assert found.visible == pytest.approx(share, abs=0.08)


def test_mirror_image_fits_worse() -> None:
    part = part_of(BRACKET)
    other = BRACKET.copy()
    other.apply_transform(np.diag([1, -1, 1, 1]))
    library = Library((part, part_of(other, "mirrored")))
    for seed in range(4):
        found = locate(library, seen_from_origin(part, any_pose(seed)), CAMERA)
        assert [candidate.cad for candidate in found.candidates] == ["part", "mirrored"]


def test_a_wall_far_behind_a_part_changes_no_answer() -> None:
    """As for a forest: `qs3.points.outliers.attached`."""
    library, scan = Library((part_of(BRACKET),)), seen_from_origin(part_of(BRACKET), any_pose(3))
    wall = np.random.default_rng(0).uniform((-1, -1, 2.5), (1, 1, 2.6), (len(scan) // 5, 3))
    alone, before_wall = (locate(library, cloud, CAMERA) for cloud in (scan, [*scan, *wall]))
    assert alone.best is not None and before_wall.best is not None
    assert not alone.lost and not before_wall.lost
    np.testing.assert_allclose(before_wall.best.pose, alone.best.pose, atol=1e-3)


def test_pose_moves_with_the_scan() -> None:
    part = part_of(BRACKET)
    scan, move = seen_from_origin(part, any_pose(1)), any_pose(7)
    still = locate(Library((part,)), scan, CAMERA).best
    x, y, z = move[:3, 3].tolist()
    moved = locate(Library((part,)), transform_points(move, scan), Place(camera=(x, y, z))).best
    assert still is not None and moved is not None
    np.testing.assert_allclose(
        transform_points(moved.pose, part.points.astype(np.float64)),
        transform_points(move @ still.pose, part.points.astype(np.float64)),
        atol=1e-3,
    )


@pytest.mark.parametrize("ending", ["glb", "stl", "obj"])
def test_pose_belongs_to_the_file_as_others_load_it(tmp_path: Path, ending: str) -> None:
    mesh = BRACKET.copy()
    if ending != "glb":
        mesh.apply_scale(1000)
    path = tmp_path / "cad" / f"bracket.{ending}"
    path.parent.mkdir()
    mesh.export(path)
    library = Library.of_folder(path.parent, None if ending == "glb" else "mm")
    pose = any_pose(2)
    scan = seen_from_origin(part_of(BRACKET), pose)
    found = locate(library, scan, CAMERA).best
    assert found is not None
    loaded = trimesh.load(path, force="mesh")
    vertices = np.asarray(loaded.vertices) * (1.0 if ending == "glb" else 1e-3)
    # Ours keeps the order of no vertex: compare with the nearest of the true ones.
    true = transform_points(pose, np.asarray(BRACKET.vertices))
    near = trimesh.proximity.closest_point(trimesh.Trimesh(true, BRACKET.faces, process=False),
                                           transform_points(found.pose, vertices))[1]  # fmt: skip
    assert near.max() < 1e-3


def test_faces_inside_an_assembly_are_seen_by_no_camera() -> None:
    inside = [trimesh.creation.box((0.05, 0.04, 0.03)), trimesh.creation.icosphere(2, 0.02)]
    inside[1].apply_translation((0.03, 0, 0))
    mesh = trimesh.util.concatenate([trimesh.creation.box((0.1, 0.08, 0.06)), *inside])
    at = np.abs(part_of(mesh).points) / (0.05, 0.04, 0.03)
    assert np.mean(at.max(axis=1) < 0.98) < 1e-3  # a hole between two points shows one at times


def test_a_fine_mesh_lies_as_a_coarse_one() -> None:
    fine, coarse = (trimesh.creation.icosphere(n, 0.05).triangles for n in (6, 2))
    directions, shares = resting_directions(fine)
    assert len(directions) == len(shares) == 64
    assert shares.sum() == pytest.approx(1, abs=1e-5)
    apart = directions @ directions.T - 2 * np.eye(64)
    assert apart.max() < np.cos(np.radians(8))
    assert len(resting_directions(coarse)[0]) == 64


def test_a_mesh_of_many_faces_lies_as_it_did_and_keeps_its_edges(tmp_path: Path) -> None:
    sides = np.array((30.0, 20.0, 10.0))
    mesh = trimesh.creation.box(sides)
    for _ in range(7):
        mesh = mesh.subdivide()
    mesh.export(tmp_path / "block.stl")
    coarse = with_fewer_faces(mesh, 256)
    assert len(coarse.faces) < 0.8 * len(mesh.faces)
    assert coarse.extents == pytest.approx(sides, rel=1e-6)
    assert coarse.area == pytest.approx(mesh.area, rel=0.02)
    ((part, whole),) = look_at(collect(tmp_path), "mm", [])
    down = np.vstack([np.eye(3), -np.eye(3)])
    assert np.abs((part.resting @ down.T).max(axis=0) - 1).max() < 1e-4 and len(part.resting) == 6
    for fine in (whole, whole.subdivide().subdivide()):  # 1,536 edges, and 6,144
        lines = sharp_edges(fine)
        outer = (np.abs(lines) > (1 - 1e-5) * sides / 2).all(axis=1).sum(axis=1)
        assert len(lines) <= 4000 and (outer >= 2).mean() > 0.98  # ends join at corners
        assert np.linalg.norm(lines[:, 1] - lines[:, 0], axis=1).sum() == pytest.approx(240, 0.02)


def test_a_smooth_mesh_of_many_faces_has_no_edge(tmp_path: Path) -> None:
    ring = trimesh.creation.torus(30, 20, major_sections=500, minor_sections=250)
    ring.apply_transform(trimesh.transformations.euler_matrix(0.3, 0.5, 0.7))
    ring.export(tmp_path / "ring.stl")
    ((_, mesh),) = look_at(collect(tmp_path), "mm", [])
    assert len(sharp_edges(mesh)) == 0


@pytest.mark.parametrize("shape", ["bracket", "plate"])
def test_library_of_the_last_version_is_read_and_named(tmp_path: Path, caplog, shape) -> None:
    """Its symmetries may have turns beside the exact ones, if a part has several."""
    TOLD.clear()
    mesh = BRACKET if shape == "bracket" else trimesh.creation.box((0.04, 0.04, 0.01))
    library, path = Library((part_of(mesh, shape),)), tmp_path / "library.safetensors"
    library.save(path)
    with open_arrays(path, "a library") as (handle, facts):
        arrays = {name: handle.get_tensor(name) for name in handle.keys()}  # noqa: SIM118
    write_arrays(path, arrays, {**facts, "format": 2})
    assert Library.read(path).class_names == (shape,)
    assert ("poses of plate may be turned" in caplog.text) == (shape == "plate")
    write_arrays(path, arrays, {**facts, "format": 1})
    with pytest.raises(InputError, match="has format 1, not 3; make it again"):
        Library.read(path)


def test_a_kept_library_is_of_the_same_cad_and_unit(tmp_path: Path) -> None:
    for name in ("bracket", "pin"):
        (tmp_path / "cad" / name).mkdir(parents=True)
        part_mesh = trimesh.creation.box((30, 20, 10 if name == "pin" else 5))
        part_mesh.export(tmp_path / "cad" / name / "a.stl")
    path = tmp_path / "library.safetensors"
    Library.of_folder(tmp_path / "cad", "mm").save(path)
    for units in (None, "mm"):
        assert len(kept_library(path, tmp_path / "cad", units).parts) == 2
    with pytest.raises(InputError, match="a in another unit; name another file, or remove it"):
        kept_library(path, tmp_path / "cad", "in")
    with pytest.raises(InputError, match="has pin/a, which is none of the CAD asked for"):
        kept_library(path, tmp_path / "cad", "mm", ["bracket"])
    some = tmp_path / "some.safetensors"
    Library.of_folder(tmp_path / "cad", "mm", ["bracket"]).save(some)
    assert kept_library(some, tmp_path / "cad", None, ["bracket"]).class_names == ("bracket",)
    for classes in ((), ["bracket", "pin"]):
        with pytest.raises(InputError, match="lacks pin/a, which is asked for; name another file"):
            kept_library(some, tmp_path / "cad", None, classes)
    held, box = path.read_bytes(), trimesh.creation.box((30, 20, 20))
    box.export(tmp_path / "cad" / "pin" / "a.stl")  # CAD that has changed
    with pytest.raises(InputError, match="changed since: pin/a; name another file, or remove it"):
        library_of(tmp_path / "cad", "mm", keep=path)
    assert path.read_bytes() == held
    Library(tuple(replace(part, digest="") for part in Library.read(path))).save(path)
    with pytest.raises(InputError, match="kept by an earlier release"):
        kept_library(path, tmp_path / "cad")
    (tmp_path / "cad" / "pin").rename(tmp_path / "cad" / "peg")
    with pytest.raises(InputError, match="has pin/a, which is none of the CAD asked for"):
        kept_library(path, tmp_path / "cad")


def test_a_kept_library_may_lack_cad_that_cannot_be_used(tmp_path: Path, caplog: Any) -> None:
    trimesh.creation.box((30, 20, 5)).export(tmp_path / "bracket.stl")
    (tmp_path / "pin.stl").write_text("solid pin\nendsolid pin\n")
    path = tmp_path / "library.safetensors"
    Library.of_folder(tmp_path).save(path)
    caplog.clear()
    TOLD.clear()
    assert kept_library(path, tmp_path).class_names == ("bracket",)
    assert "pin.stl" in caplog.text and "it is skipped" in caplog.text
    trimesh.creation.box((30, 20, 10)).export(tmp_path / "pin.stl")
    with pytest.raises(InputError, match="lacks pin, which is asked for"):
        kept_library(path, tmp_path)


def test_a_library_of_some_classes(tmp_path: Path) -> None:
    pin = part_of(trimesh.creation.cylinder(0.004, 0.02), "pin")
    library = Library((part_of(BRACKET, "bracket"), pin, part_of(BRACKET, "bracket")))
    assert library.only(["bracket"]).parts == (library.parts[0], library.parts[2])
    some = library.only({"pin"})
    assert some.largest == library.largest > 2 * pin.diameter
    some.save(tmp_path / "some.safetensors")
    assert Library.read(tmp_path / "some.safetensors").largest == library.largest
    for classes in (["nut"], ["pin", "nut"], []):
        with pytest.raises(InputError, match="there is bracket, pin"):
            library.only(classes)


@pytest.mark.parametrize(
    ("name", "factor", "fault"),
    [("points", 1e30, "its size is"), ("points", 0, "its size is"), ("normals", 7, "a normal"),
     ("seen", 0, "a view shows one"), ("spacing", 1e-300, "its size is")],
)  # fmt: skip
def test_a_library_with_a_damaged_part_is_refused(tmp_path: Path, name, factor, fault) -> None:
    path, part = tmp_path / "library.safetensors", part_of(BRACKET)
    value = getattr(part, name)
    damaged = value * factor if name == "spacing" else (value * factor).astype(value.dtype)
    Library((replace(part, **{name: damaged}),)).save(path)
    with pytest.raises(InputError, match=f"library.safetensors: part .* is damaged: {fault}"):
        Library.read(path)


@pytest.mark.parametrize("away", [(0, 0, 0), (500060.25, -45, 3)])
def test_command_writes_class_file_and_pose(tmp_path: Path, typed, away) -> None:
    (tmp_path / "cad").mkdir()
    BRACKET.export(tmp_path / "cad" / "bracket.stl")
    trimesh.creation.cylinder(0.015, 0.05).export(tmp_path / "cad" / "pin.stl")
    pose = any_pose(1)
    np.save(tmp_path / "scan.npy", seen_from_origin(part_of(BRACKET), pose) + np.float64(away))
    out = tmp_path / "found.json"
    done = typed("locate", tmp_path / "cad", tmp_path / "scan.npy", "--units", "m", "--json", out,
               "--camera", *away)  # fmt: skip
    (row,) = json.loads(out.read_text())
    assert (row["class"], row["cad"], row["lost"]) == ("bracket", "bracket", False)
    assert turned_by(np.array(row["pose"]), pose) < 1
    np.testing.assert_allclose(np.array(row["pose"])[:3, 3], pose[:3, 3] + away, atol=5e-4)
    assert "bracket" in done.stdout
    (tmp_path / "scans").mkdir()
    np.save(tmp_path / "scans" / "scan.npy", np.load(tmp_path / "scan.npy"))
    line = typed.refuses("locate", tmp_path / "scans", tmp_path / "cad")
    assert "name the CAD first, then the scans" in line
    np.save(tmp_path / "ball.npy", trimesh.creation.icosphere(3, 0.03).vertices)
    kept = tmp_path / "kept.safetensors"
    Library.of_folder(tmp_path / "cad", "m").save(kept)
    for place in ("cad", "adapted"):  # a run beside CAD is in nobody's way
        (tmp_path / place / "run").mkdir(parents=True)
        (tmp_path / place / "run" / "run.json").write_text("{}")
    for cad, fix in ((tmp_path / "cad", "prints sizes; --units"), (kept, "make it with --units")):
        assert f"{fix})? Does each" in typed("locate", cad, tmp_path / "ball.npy").stderr
    line = typed.refuses("locate", tmp_path / "adapted", tmp_path / "ball.npy")
    assert line.endswith(f"did you mean {tmp_path / 'adapted' / 'run'}?")
