"""Laws that every built-in machine part keeps."""

from pathlib import Path

import numpy as np
import pytest

from qs3 import shapes
from qs3.errors import InputError
from qs3.meshes.collections import collect, load_named
from qs3.meshes.sizes import file_size
from qs3.shapes._solids import assemble
from qs3.shapes.parts import _circle, _rectangle, _terrace


@pytest.mark.parametrize("name", shapes.PARTS)
def test_parts_are_closed_small_and_nearly_alike(name: str) -> None:
    meshes = [shapes.make(name, seed) for seed in range(10)]
    for mesh in meshes:
        assert mesh.is_volume
        size, unit = file_size(mesh)
        assert 0.02 < size < 0.12 and unit == "m"
        assert mesh.extents.min() > 0.018
    volumes = np.array([mesh.volume for mesh in meshes])
    assert 1.02 < volumes.max() / volumes.min() < 1.5  # of one part, with its tolerances


def test_a_seed_gives_one_part_and_classes_differ() -> None:
    for name in shapes.PARTS:
        first, again, other = (shapes.make(name, seed) for seed in (7, 7, 8))
        assert np.array_equal(first.vertices, again.vertices)
        assert np.array_equal(first.faces, again.faces)
        assert not np.allclose(first.extents, other.extents)
    sizes = np.array([np.sort(shapes.make(name).extents) for name in shapes.PARTS])
    apart = np.abs(sizes[:, None] - sizes).max(axis=2)
    assert apart[np.triu_indices(len(sizes), 1)].min() > 0.004


def test_volume_of_a_terrace_is_that_of_its_prisms() -> None:
    contours = [(_rectangle(0.05, 0.04), 0.01), (_circle(0.02), 0.03), (_circle(0.01), 0.0)]
    mesh = assemble([_terrace(contours)])
    area = [48 / 8 * d**2 * np.sin(2 * np.pi / 48) for d in (0.02, 0.01)]  # 48-gons
    assert mesh.is_volume
    assert mesh.volume == pytest.approx(0.05 * 0.04 * 0.01 + area[0] * 0.02 - area[1] * 0.03)


def test_parts_are_a_collection(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    items = collect("parts", per_class=2)
    assert [item.class_name for item in items[::2]] == list(shapes.PARTS)
    assert np.array_equal(items[0].load().vertices, collect("parts")[0].load().vertices)
    assert load_named("gear", 3)[0].units == "meters"
    with pytest.raises(InputError, match="choose one of bolt"):
        collect("parts", classes=["chair"])
    monkeypatch.chdir(tmp_path)
    (tmp_path / "parts").mkdir()
    with pytest.raises(InputError, match=r"write \./parts for the folder"):
        collect("parts")
