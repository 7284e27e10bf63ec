import numpy as np
import pytest

from qs3.errors import InputError
from qs3.io.layouts.trees import FORMATS, GRASPNET
from qs3.io.load import detect, load_clouds, load_unlabelled
from qs3.meshes.classes import POINTDA10

SPECKLE, DEPTH = FORMATS[:2]
BY_NAME = {layout.name.removeprefix("graspnetpc10-"): layout for layout in FORMATS[2:]}
DOMAINS = ("Synthetic/kinect", "Synthetic/realsense", "Real/kinect", "Real/realsense")


def released_tree(root, classes=("night_stand", "chair"), parts=("train", "test")):
    """Text files as the released code reads them; written by hand."""
    for number, name in enumerate(classes):
        for part in parts:
            (root / name / part).mkdir(parents=True)
            lines = [f"{number} {i} {i / 8}" for i in range(4)]
            (root / name / part / f"{name}_0001.xyz").write_text("\n".join(lines) + "\n")
    return root


@pytest.mark.parametrize(
    ("layout", "folder"),
    [(SPECKLE, "raw_pc_multiview_point_at"), (DEPTH, "Scannet_single_obj_1012_new")],
)
def test_the_released_tree_is_known_by_its_folder(tmp_path, layout, folder):
    released_tree(tmp_path / folder)
    for path in (tmp_path, tmp_path / folder):
        assert detect(path) is layout
        clouds = layout.read(path, "train")
        assert [POINTDA10[label] for label in clouds.labels] == ["chair", "cabinet"]
    assert load_clouds(tmp_path, split="test", num_points=4).class_names == POINTDA10
    # Under another name only --from tells.
    (tmp_path / folder).rename(tmp_path / "renamed")
    assert detect(tmp_path / "renamed").name == "xyz"
    assert len(layout.read(tmp_path / "renamed", None).ids) == 4


def test_convention_both_trees_are_z_up_on_disk_and_stay_so(tmp_path):
    # A lamp: a wide foot at z = 0, a pole up to z = 2, a shade that looks along +x at its top.
    lamp = np.array(
        [[0.5, 0, 0], [-0.5, 0, 0], [0, 0.5, 0], [0, 0, 1], [0, 0, 2], [0.7, 0, 2], [0.7, 0.1, 2]]
    )
    (tmp_path / "lamp" / "train").mkdir(parents=True)
    np.savetxt(tmp_path / "lamp" / "train" / "a.xyz", lamp)
    for layout in (SPECKLE, DEPTH):
        points = layout.read(tmp_path, None).clouds[0]
        np.testing.assert_array_equal(points, lamp.astype(np.float32))
        assert points[:, 2].argmax() >= 4
        assert points[:, 2].min() == 0


def test_a_tree_of_another_kind_is_refused(tmp_path):
    root = released_tree(tmp_path / "a", classes=("chair", "toilet"))
    with pytest.raises(InputError, match=r"a: class 'toilet' is none of"):
        SPECKLE.read(root, None)
    (root / "chair" / "b.xyz").write_text("1 2 3\n")
    with pytest.raises(InputError, match=r"b\.xyz: lies outside <class>/<train\|test>"):
        SPECKLE.read(root, None)
    with pytest.raises(InputError, match="no split 'dev'"):
        SPECKLE.read(released_tree(tmp_path / "c"), "dev")
    with pytest.raises(InputError, match="no such folder"):
        SPECKLE.read(tmp_path / "d", None)
    bad = released_tree(tmp_path / "e") / "chair" / "train" / "chair_0001.xyz"
    bad.write_text("1 2\n")
    with pytest.raises(InputError, match=r"chair_0001\.xyz: line 1 has 2 columns") as caught:
        SPECKLE.read(tmp_path / "e", None)
    assert str(caught.value).count("chair_0001") == 1


def graspnet_release(root):
    """One cloud a split, domain and class, whose x tells the domain; written by hand."""
    for part in ("train", "test"):
        for number, domain in enumerate(DOMAINS):
            for digit in range(10):
                folder = root / part / domain / str(digit)
                folder.mkdir(parents=True)
                (folder / "0001.xyz").write_text(f"{number} {digit} 0.5\n" * 3)
    return root


def test_the_domains_are_told_apart(tmp_path):
    root = graspnet_release(tmp_path)
    seen = {}
    for name, layout in BY_NAME.items():
        clouds = layout.read(root, "train")
        assert clouds.class_names == GRASPNET
        assert [int(cloud[0, 1]) for cloud in clouds.clouds] == clouds.labels.tolist()
        assert set(clouds.splits) == {"train"}
        seen[name] = sorted({int(cloud[0, 0]) for cloud in clouds.clouds})
    assert seen == {
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
    root = graspnet_release(tmp_path / "GraspNetPointClouds")
    for load in (load_clouds, load_unlabelled):
        with pytest.raises(InputError, match=r"several layouts.*--from graspnetpc10-real-kinect"):
            load(root)


def test_a_graspnet_tree_of_another_kind_is_refused(tmp_path):
    layout = BY_NAME["real-kinect"]
    with pytest.raises(InputError, match="no such folder"):
        layout.read(tmp_path / "nowhere", None)
    with pytest.raises(InputError, match=r"no cloud in <train\|test>/Real/kinect/<0-9>"):
        layout.read(tmp_path, None)
    root = graspnet_release(tmp_path / "set")
    (root / "train" / "Real" / "kinect" / "10").mkdir()
    with pytest.raises(InputError, match="class folders are 0 to 9"):
        layout.read(root, None)
    with pytest.raises(InputError, match="no split 'dev'"):
        BY_NAME["real-realsense"].read(root, "dev")
