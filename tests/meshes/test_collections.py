"""Collections: shapes, class folders, ModelNet's layout, flat folders."""

from pathlib import Path

import numpy as np
import pytest

from qs3 import shapes
from qs3.errors import InputError
from qs3.meshes import collect


def test_shapes_are_ten_classes_with_own_seeds() -> None:
    items = collect("shapes", per_class=5)
    assert len(items) == 50
    assert [item.id for item in items] == sorted(item.id for item in items)
    assert items[0].id == "shapes/bathtub/000000"
    assert tuple(dict.fromkeys(item.class_name for item in items)) == shapes.CLASSES
    seeds = [item.shape_seed for item in items]
    assert len(set(seeds)) == 50
    assert all(seed is not None and 0 <= seed < 2**63 for seed in seeds)
    assert items == collect("shapes", per_class=5)
    assert collect("shapes", per_class=2, classes=["sofa"]) == items[40:42]  # fewer are a part
    others = collect("shapes", per_class=5, seed=1)
    assert not set(seeds) & {item.shape_seed for item in others}
    mesh = items[21].load()
    assert np.array_equal(mesh.vertices, items[21].load().vertices)


def test_bad_sources(tree, tmp_path: Path) -> None:
    with pytest.raises(InputError, match="holds no mesh"):
        collect(tmp_path)
    with pytest.raises(InputError, match="no such folder"):
        collect(tmp_path / "none")
    root = tree("chair/train/a.off")
    with pytest.raises(InputError, match="is a file"):
        collect(root / "chair/train/a.off")
    with pytest.raises(InputError, match="unknown"):
        collect("shapes", classes=["piano"])
    with pytest.raises(InputError, match="at least 1"):
        collect("shapes", per_class=0)
    with pytest.raises(InputError, match="from 0 up"):
        collect("shapes", seed=-1)


@pytest.mark.data
def test_artists_folder(shared_data: Path) -> None:
    items = collect(shared_data / "cad")
    assert len(items) == 147
    assert len({item.id for item in items}) == 147
    assert {item.class_name for item in items} == set(shapes.CLASSES)
