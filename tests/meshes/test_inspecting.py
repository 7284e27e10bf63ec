"""Hints: each named fault of a sound mesh is told, and a sound mesh gets none."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from qs3 import shapes
from qs3.meshes import collect
from qs3.meshes.inspecting import PICTURED, inspect, looks_y_up


def bench() -> trimesh.Trimesh:
    return trimesh.creation.box(bounds=[[-0.6, -0.2, 0.0], [0.6, 0.2, 0.45]])


def hints_of(folder: Path, mesh: trimesh.Trimesh) -> tuple[str, ...]:
    mesh.export(folder / "a.obj")
    (found,) = inspect(collect(folder))
    return found.hints


def test_a_sound_mesh_gets_no_hint(tmp_path: Path) -> None:
    assert hints_of(tmp_path, bench()) == ()
    (found,) = inspect(collect(tmp_path))
    assert found.size == pytest.approx(1.2)
    assert found.extents == pytest.approx([1.2, 0.4, 0.45])


@pytest.mark.parametrize("name", shapes.PARTS)
def test_a_part_with_slivers_is_closed(tmp_path: Path, name: str) -> None:
    """Faces without area are left out, and their edges lie along several others."""
    shapes.make(name, seed=3).export(tmp_path / "a.stl")
    (found,) = inspect(collect(tmp_path))
    assert found.hints == ()


@pytest.mark.parametrize("fault", ["y-up", "millimetres", "open", "both ways"])
def test_each_fault_is_told_and_no_other(tmp_path: Path, fault: str) -> None:
    mesh = bench()
    if fault == "y-up":
        mesh.vertices = np.stack([mesh.vertices[:, i] for i in (0, 2, 1)], axis=1) * [1, 1, -1]
    elif fault == "millimetres":
        mesh.vertices *= 1000
    elif fault == "open":
        mesh.update_faces(np.arange(len(mesh.faces)) > 0)
    else:
        mesh.faces = np.concatenate([mesh.faces[:1, ::-1], mesh.faces[1:]])
    (hint,) = hints_of(tmp_path, mesh)
    assert fault in hint


def test_a_fine_mesh_is_simplified_to_be_drawn(tmp_path: Path) -> None:
    """Also a soup of triangles, as STL has them; the fine mesh is neither moved nor torn."""
    ball = trimesh.creation.icosphere(7, 30.0)
    box = trimesh.creation.box((60, 40, 0.02))
    for _ in range(7):
        box = box.subdivide()
    for number, mesh in enumerate((ball, box)):
        root = tmp_path / str(number)
        root.mkdir()
        mesh.export(root / "a.stl")
        (found,) = inspect(collect(root))
        assert found.hints == ("names no unit, looks to be in millimetres: --units",)
        assert found.mesh is not None and len(found.mesh.faces) < len(mesh.faces) / 1.5
        assert found.mesh.extents == pytest.approx(mesh.extents, rel=0.02, abs=1e-9)
        assert found.mesh.area == pytest.approx(mesh.area, rel=0.02)
        drawn = trimesh.Trimesh(found.mesh.vertices, found.mesh.faces)
        _, uses = np.unique(drawn.edges_sorted, axis=0, return_counts=True)
        assert (uses % 2 == 0).all()  # no side is open
        if mesh is ball:
            radii = np.linalg.norm(drawn.vertices - drawn.bounds.mean(axis=0), axis=1)
            assert np.abs(radii - 30).max() < 0.3  # a cell is 0.47 mm
    small = tmp_path / "small"
    small.mkdir()
    bench().export(small / "a.stl")
    (found,) = inspect(collect(small))
    assert found.mesh is not None and len(found.mesh.faces) == 12


def test_only_meshes_that_are_drawn_are_kept(tmp_path: Path) -> None:
    for number in range(PICTURED + 2):
        (tmp_path / "bench").mkdir(exist_ok=True)
        bench().export(tmp_path / "bench" / f"{number:02d}.stl")
    kept = [found.mesh is not None for found in inspect(collect(tmp_path))]
    assert kept == [True] * PICTURED + [False] * 2


def test_a_mesh_that_cannot_be_read_is_a_fault(tmp_path: Path) -> None:
    (tmp_path / "a.off").write_text("OFF\n3 1 0\n")
    (found,) = inspect(collect(tmp_path))
    assert "cut short" in found.fault
    assert found.extents is None


@pytest.mark.parametrize("name", shapes.CLASSES)
def test_built_in_shapes_stand_on_z_and_are_found_when_laid_down(name: str) -> None:
    mesh = shapes.make(name, 3)
    assert not looks_y_up(mesh)
    mesh.vertices[:, 2] -= mesh.bounds[0, 2]
    mesh.vertices[:, :2] -= mesh.bounds[:, :2].mean(axis=0)
    mesh.vertices = mesh.vertices[:, [0, 2, 1]] * [1, 1, -1]
    assert looks_y_up(mesh)
