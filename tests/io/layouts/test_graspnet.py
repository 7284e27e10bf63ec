import dataclasses

import numpy as np
import pytest

from qs3.errors import InputError
from qs3.io.detect import detect, matching
from qs3.io.layouts.graspnet import CLASSES, FORMATS
from qs3.io.load import load_clouds, load_unlabelled

BY_NAME = {layout.name.removeprefix("graspnetpc10-"): layout for layout in FORMATS}
WRITTEN = [layout for layout in FORMATS if layout.write is not None]


def released_tree(root):
    """One cloud a split, domain and class, whose x tells the domain; written by hand."""
    for part in ("train", "test"):
        for domain in ("Synthetic/kinect", "Synthetic/realsense", "Real/kinect", "Real/realsense"):
            for digit in range(10):
                folder = root / part / domain / str(digit)
                folder.mkdir(parents=True)
                x = ["Synthetic/kinect", "Synthetic/realsense", "Real/kinect", "Real/realsense"]
                (folder / "0001.xyz").write_text(f"{x.index(domain)} {digit} 0.5\n" * 3)
    return root


def test_the_domains_are_told_apart(tmp_path):
    root = released_tree(tmp_path)
    found = {}
    for name, layout in BY_NAME.items():
        clouds = layout.read(root, "train")
        assert clouds.class_names == CLASSES
        assert [int(cloud[0, 1]) for cloud in clouds.clouds] == clouds.labels.tolist()
        assert set(clouds.splits) == {"train"}
        found[name] = sorted({int(cloud[0, 0]) for cloud in clouds.clouds})
    assert found == {
        "synthetic": [0, 1],
        "synthetic-kinect": [0],
        "synthetic-realsense": [1],
        "real-kinect": [2],
        "real-realsense": [3],
    }
    assert len(BY_NAME["real-kinect"].read(root, None).ids) == 20


def test_convention_the_digit_is_the_label_and_no_axis_is_turned(tmp_path):
    folder = tmp_path / "train" / "Real" / "kinect" / "3"
    folder.mkdir(parents=True)
    drill = np.array([[0, 0, 0.1], [0, 0, 0.9], [0.4, 0, 0.9], [0.4, 0.05, 0.9]])
    np.savetxt(folder / "a.xyz", drill)
    clouds = BY_NAME["real-kinect"].read(tmp_path, None)
    assert clouds.class_names[clouds.labels[0]] == "power drill"
    np.testing.assert_array_equal(clouds.clouds[0], drill.astype(np.float32))


def test_a_whole_release_needs_the_domain_named(tmp_path):
    root = released_tree(tmp_path / "GraspNetPointClouds")
    assert len(matching(root)) == 5
    for load in (load_clouds, load_unlabelled):
        with pytest.raises(InputError, match=r"several layouts.*--from graspnetpc10-real-kinect"):
            load(root)


@pytest.mark.parametrize("layout", WRITTEN, ids=lambda layout: layout.name)
def test_what_is_written_reads_back_equal(rng, tmp_path, formats, layout):
    clouds = formats.make_clouds(rng, CLASSES, num_points=1024)
    layout.write(tmp_path / "set", clouds)
    assert formats.told(layout.read(tmp_path / "set", None)) == formats.told(clouds)
    assert detect(tmp_path / "set") is layout
    assert len(load_clouds(tmp_path / "set", split="test")) == 10


def test_what_the_layout_cannot_hold_is_refused(rng, tmp_path, formats):
    layout = BY_NAME["real-kinect"]
    clouds = formats.make_clouds(rng, CLASSES, num_points=1024)
    bad = {
        "needs labels": dataclasses.replace(clouds, labels=None),
        "needs train or test": dataclasses.replace(clouds, splits=()),
        "class 'chair' is none of": dataclasses.replace(clouds, class_names=("chair",) * 10),
        "has 7 points, and this layout has 1024": dataclasses.replace(
            clouds, clouds=[np.zeros((7, 3))] * 20
        ),
    }
    for message, wrong in bad.items():
        with pytest.raises(InputError, match=message):
            layout.write(tmp_path / "set", wrong)
    assert not (tmp_path / "set").exists()


def test_a_tree_of_another_kind_is_refused(tmp_path):
    layout = BY_NAME["real-kinect"]
    with pytest.raises(InputError, match="no such folder"):
        layout.read(tmp_path / "nowhere", None)
    with pytest.raises(InputError, match=r"no cloud in <train\|test>/Real/kinect/<0-9>"):
        layout.read(tmp_path, None)
    root = released_tree(tmp_path / "set")
    (root / "train" / "Real" / "kinect" / "10").mkdir()
    with pytest.raises(InputError, match="class folders are 0 to 9"):
        layout.read(root, None)
    with pytest.raises(InputError, match="no split 'dev'"):
        BY_NAME["real-realsense"].read(root, "dev")
