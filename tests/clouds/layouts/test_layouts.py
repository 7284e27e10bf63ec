"""Laws of every layout that is written."""

import dataclasses

import numpy as np
import pytest

from qs3.clouds.layouts import formats
from qs3.clouds.load import detect
from qs3.errors import InputError

from .common import content, make_clouds

WRITTEN = [layout for layout in formats().values() if layout.write is not None]


def target(folder, layout):
    return folder / "a.npz" if layout.name == "npz" else folder / "a"


def files(root):
    paths = [path for path in sorted(root.rglob("*")) if path.is_file()]
    return {path.relative_to(root).as_posix(): path.read_bytes() for path in paths}


@pytest.mark.parametrize("layout", WRITTEN, ids=lambda layout: layout.name)
def test_written_clouds_read_back_equal_and_have_equal_bytes(tmp_path, layout, rng):
    clouds = make_clouds(rng, num_points=16)
    for run in ("one", "two"):
        (tmp_path / run).mkdir()
        layout.write(target(tmp_path / run, layout), clouds)
    assert files(tmp_path / "one") == files(tmp_path / "two")
    path = target(tmp_path / "one", layout)
    back = layout.read(path, None)
    assert content(back) == content(clouds)
    assert set(back.class_names) >= set(clouds.class_names)
    test = layout.read(path, "test")
    assert set(test.splits) == {"test"}
    assert len(test.ids) == len(clouds.ids) // 2
    assert detect(path).name == ("folder" if layout.name == "ply" else layout.name)


@pytest.mark.parametrize(
    ("name", "changes", "message"),
    [("store", {"labels": None}, "without labels"), ("npz", {}, "name a file that ends in .npz")],
)
def test_clouds_that_a_layout_cannot_hold_are_refused(tmp_path, rng, name, changes, message):
    clouds = dataclasses.replace(make_clouds(rng, num_points=16), **changes)
    with pytest.raises(InputError, match=message):
        formats()[name].write(tmp_path / "set", clouds)
    assert not (tmp_path / "set").exists()


def test_npz_keeps_clouds_of_several_sizes_and_without_labels(tmp_path, rng):
    clouds = dataclasses.replace(make_clouds(rng, num_points=16), labels=None, splits=())
    clouds.clouds[0] = clouds.clouds[0][:7]
    formats()["npz"].write(tmp_path / "a.npz", clouds)
    back = formats()["npz"].read(tmp_path / "a.npz", None)
    assert (back.labels, back.splits, back.ids) == (None, (), clouds.ids)
    for cloud, wanted in zip(back.clouds, clouds.clouds, strict=True):
        np.testing.assert_array_equal(cloud, wanted)


def test_an_archive_says_that_it_leaves_out_other_splits(tmp_path, rng, caplog):
    clouds = make_clouds(rng, num_points=16, splits=("train", "val"))
    formats()["npz"].write(tmp_path / "a.npz", clouds)
    assert formats()["npz"].read(tmp_path / "a.npz", None).splits == ()
    assert "knows train and test alone" in caplog.text
