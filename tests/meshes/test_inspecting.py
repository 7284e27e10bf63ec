"""Hints: each named fault of a sound mesh is told, and a sound mesh gets none."""

from pathlib import Path

import numpy as np
import pytest
import trimesh

from qs3 import shapes
from qs3.meshes import collect
from qs3.meshes.inspecting import inspect, looks_y_up


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
