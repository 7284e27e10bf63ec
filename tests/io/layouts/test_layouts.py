"""Laws of every layout that is written: read back equal, equal bytes, one line where it cannot."""

import dataclasses

import pytest

from qs3.errors import InputError
from qs3.io.layouts import FORMATS, modelnet, scanobjectnn, trees
from qs3.io.load import detect
from qs3.meshes.classes import POINTDA10

from .common import content, make_clouds

WRITTEN = [layout for layout in FORMATS.values() if layout.write is not None]
CLASSES = {
    "modelnet40-h5": modelnet.CLASSES,
    "scanobjectnn": scanobjectnn.CLASSES,
    **{layout.name: trees.GRASPNET for layout in trees.FORMATS[2:]},
}
POINTS = {"specklenet10": 2048, **{layout.name: 1024 for layout in trees.FORMATS[2:]}}
ANYBODYS = ("ply", "pcd", "npy", "xyz")


def files(root):
    paths = [path for path in sorted(root.rglob("*")) if path.is_file()]
    return {path.relative_to(root).as_posix(): path.read_bytes() for path in paths}


@pytest.fixture
def clouds(rng, layout):
    classes = CLASSES.get(layout.name, POINTDA10)
    return make_clouds(rng, classes, num_points=POINTS.get(layout.name, 16))


@pytest.mark.parametrize("layout", WRITTEN, ids=lambda layout: layout.name)
def test_what_is_written_reads_back_equal_and_again_gives_equal_bytes(tmp_path, layout, clouds):
    for run in ("a", "b"):
        layout.write(tmp_path / run, clouds)
    assert files(tmp_path / "a") == files(tmp_path / "b")
    back = layout.read(tmp_path / "a", None)
    assert content(back) == content(clouds)
    assert set(back.class_names) == set(clouds.class_names)
    test = layout.read(tmp_path / "a", "test")
    assert set(test.splits) == {"test"}
    assert len(test.ids) == len(clouds.ids) // 2
    # PointDA-10's own layout is found out; the ways to read and write it are named.
    assert detect(tmp_path / "a").name in (layout.name, "pointda10")


@pytest.mark.parametrize("layout", WRITTEN, ids=lambda layout: layout.name)
def test_what_a_layout_cannot_hold_is_refused_before_anything_is_written(tmp_path, layout, clouds):
    bad = {"labels": dataclasses.replace(clouds, labels=None)}
    if layout.name != "store":
        bad["needs train or test"] = dataclasses.replace(clouds, splits=())
        other = (*clouds.class_names[:-1], "spaceship")
        if layout.name != "modelnet40-h5":  # which takes any names
            bad["class 'spaceship' is none of"] = dataclasses.replace(clouds, class_names=other)
    if layout.name in POINTS:
        few = dataclasses.replace(clouds, clouds=[cloud[:7] for cloud in clouds.clouds])
        bad[f"has 7 points, and this layout has {POINTS[layout.name]}; add --num-points"] = few
    for message, wrong in bad.items() if layout.name not in ANYBODYS else ():
        with pytest.raises(InputError, match=message):
            layout.write(tmp_path / "set", wrong)
    assert not (tmp_path / "set").exists()
