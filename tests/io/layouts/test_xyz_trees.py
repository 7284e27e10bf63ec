import dataclasses

import numpy as np
import pytest

from qs3.errors import InputError
from qs3.io.detect import detect
from qs3.io.layouts.xyz_trees import DEPTHSCANNET_FOLDER, FORMATS, SPECKLENET_FOLDER
from qs3.io.load import load_clouds
from qs3.meshes.classes import POINTDA10

SPECKLE, DEPTH = FORMATS


def released_tree(root, classes=("night_stand", "chair"), parts=("train", "test")):
    """Text files as the released code reads them; written by hand."""
    for number, name in enumerate(classes):
        for part in parts:
            (root / name / part).mkdir(parents=True)
            lines = [f"{number} {i} {i / 8}" for i in range(4)]
            (root / name / part / f"{name}_0001.xyz").write_text("\n".join(lines) + "\n")
    return root


@pytest.mark.parametrize("layout", FORMATS, ids=lambda layout: layout.name)
def test_what_is_written_reads_back_equal(rng, tmp_path, formats, layout):
    clouds = formats.make_clouds(rng, num_points=2048)
    layout.write(tmp_path / "set", clouds)
    assert detect(tmp_path / "set") is layout
    back = layout.read(tmp_path / "set", None)
    assert back.class_names == POINTDA10
    assert formats.told(back) == formats.told(clouds)
    test = layout.read(tmp_path / "set", "test")
    assert set(test.splits) == {"test"}
    assert len(test.ids) == 10


@pytest.mark.parametrize(
    ("layout", "folder"), [(SPECKLE, SPECKLENET_FOLDER), (DEPTH, DEPTHSCANNET_FOLDER)]
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
    for layout in FORMATS:
        points = layout.read(tmp_path, None).clouds[0]
        np.testing.assert_array_equal(points, lamp.astype(np.float32))
        assert points[:, 2].argmax() >= 4
        assert points[:, 2].min() == 0


@pytest.mark.parametrize("layout", FORMATS, ids=lambda layout: layout.name)
def test_what_the_layout_cannot_hold_is_refused(rng, tmp_path, formats, layout):
    clouds = formats.make_clouds(rng, num_points=2048)
    bad = {
        "needs labels": dataclasses.replace(clouds, labels=None),
        "needs train or test": dataclasses.replace(clouds, splits=()),
        "class 'toilet' is none of": dataclasses.replace(
            clouds, class_names=(*POINTDA10[:9], "toilet")
        ),
    }
    for message, wrong in bad.items():
        with pytest.raises(InputError, match=message):
            layout.write(tmp_path / "set", wrong)
    assert not (tmp_path / "set").exists()


def test_specklenet_has_2048_points(rng, tmp_path, formats):
    few = formats.make_clouds(rng, num_points=8)
    with pytest.raises(InputError, match="has 8 points, and this layout has 2048; add --num"):
        SPECKLE.write(tmp_path / "set", few)
    DEPTH.write(tmp_path / "set", few)


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
