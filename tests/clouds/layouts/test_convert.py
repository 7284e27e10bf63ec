import os

import numpy as np
import pytest

from qs3.clouds.files import read_cloud
from qs3.clouds.layouts.folders import write_folder
from qs3.clouds.layouts.store import read_ragged
from qs3.clouds.load import convert, read_clouds
from qs3.clouds.types import RaggedClouds
from qs3.errors import InputError
from qs3.meshes.classes import POINTDA10
from qs3.store.manifest import open_dataset

from .common import make_clouds


@pytest.fixture
def source(rng, tmp_path):
    """A folder with all ten classes and both splits."""
    clouds = make_clouds(rng, num_points=64)
    write_folder(tmp_path / "source", clouds)
    return tmp_path / "source"


def test_a_store_tells_where_it_comes_from(tmp_path, source):
    convert(source, tmp_path / "store", "store", split="test")
    manifest = open_dataset(tmp_path / "store")
    first, _ = read_clouds(source, "test")
    assert manifest.settings == {"kind": "converted", "from": "folder", "checksum": first.checksum}
    assert set(read_ragged(tmp_path / "store").splits) == {"test"}
    assert str(tmp_path) not in (tmp_path / "store" / "dataset.json").read_text()
    with pytest.raises(InputError, match="has no 'clean' clouds"):
        convert(tmp_path / "store", tmp_path / "no", "ply", cloud="clean")


def test_clouds_without_labels_go_into_folders_only(rng, tmp_path):
    bare = RaggedClouds([np.ones((3, 3), np.float32)], ("x",), "")
    write_folder(tmp_path / "flat", bare)
    assert convert(tmp_path / "flat", tmp_path / "b", "ply").labels is None
    assert [path.name for path in (tmp_path / "b").iterdir()] == ["x.ply"]
    with pytest.raises(InputError, match=r"store: .*labels"):
        convert(tmp_path / "flat", tmp_path / "c", "store")
    with pytest.raises(InputError, match="has no labels to map"):
        convert(tmp_path / "flat", tmp_path / "c", "ply", classes=POINTDA10)
    assert not (tmp_path / "c").exists()


def test_classes_are_mapped_dropped_or_named(rng, tmp_path):
    clouds = make_clouds(rng, ("desk", "night_stand", "toilet"), num_points=8)
    write_folder(tmp_path / "a", clouds)
    with pytest.raises(InputError, match=r"class 'toilet' is not one of.*--unmapped drop"):
        convert(tmp_path / "a", tmp_path / "b", "ply", classes=POINTDA10)
    assert not (tmp_path / "b").exists()
    kept = convert(tmp_path / "a", tmp_path / "b", "ply", classes=POINTDA10, unmapped="drop")
    assert kept.class_names == POINTDA10
    assert sorted(path.name for path in (tmp_path / "b").iterdir()) == ["cabinet", "table"]
    assert len(kept.ids) == len(kept.splits) == 4
    named = convert(tmp_path / "a", tmp_path / "c", "store", classes=("toilet", "table", "cabinet"))
    assert sorted(named.labels.tolist()) == [0, 0, 1, 1, 2, 2]
    assert open_dataset(tmp_path / "c").class_names == ("toilet", "table", "cabinet")
    with pytest.raises(InputError, match="no cloud is of any of sofa"):
        convert(tmp_path / "a", tmp_path / "d", "ply", classes=("sofa",), unmapped="drop")
    with pytest.raises(InputError, match="twice"):
        convert(tmp_path / "a", tmp_path / "d", "ply", classes=("table", "table"))


def test_one_number_of_points(rng, tmp_path):
    (tmp_path / "a" / "bed").mkdir(parents=True)
    for count in (5, 8, 30):
        np.save(tmp_path / "a" / "bed" / f"{count}.npy", rng.random((count, 3)))
    written = convert(tmp_path / "a", tmp_path / "b", "ply", num_points=8)
    assert [len(cloud) for cloud in written.clouds] == [8, 8, 8]
    assert {len(read_cloud(path)) for path in (tmp_path / "b" / "bed").iterdir()} == {8}
    for bad in (0, 10**12):
        with pytest.raises(InputError, match=f"num_points must be in 1 to 1000000, not {bad}"):
            convert(tmp_path / "a", tmp_path / "c", "ply", num_points=bad)


def test_names_of_other_bytes_are_escaped(tmp_path, source):
    """Names of files are bytes; those that are no UTF-8 are stored as escapes."""
    name = os.fsdecode(b"st\xfchle")
    (source / "chair").rename(source / name)
    (file,) = (source / name / "test").iterdir()
    file.rename(file.with_name(f"{name}.ply"))
    escaped = r"st\udcfchle"
    clouds, _ = read_clouds(source)
    assert escaped in clouds.class_names
    assert f"{escaped}/test/{escaped}.ply" in clouds.ids
    convert(source, tmp_path / "store", "store")
    assert escaped in open_dataset(tmp_path / "store").class_names
    assert f"{escaped}/test/{escaped}.ply" in read_ragged(tmp_path / "store").ids
