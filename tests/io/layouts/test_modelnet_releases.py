"""ModelNet's meshes, and the clouds with normals: lists beside class folders, y up."""

import numpy as np
import pytest
import trimesh

from qs3.io import load_clouds
from qs3.io.layouts.modelnet_releases import read_modelnet_meshes
from qs3.io.load import detect
from qs3.training.answers import list_clouds, read_listed

from ..hostile import refused


@pytest.fixture
def meshes(tmp_path):
    """ModelNet's tree with two classes of bricks, tall ones and flat ones."""
    root = tmp_path / "ModelNet10"
    for name, size in (("dresser", (1, 2, 5)), ("bed", (3, 4, 1))):
        for part in ("train", "test"):
            for number in range(2):
                folder = root / name / part
                folder.mkdir(parents=True, exist_ok=True)
                brick = trimesh.creation.box(size)
                brick.apply_translation((10 * number, 0, 0))
                brick.export(folder / f"{name}_{number:04d}.off")
    (root / "README.txt").write_text("ModelNet10")
    (root / "__MACOSX").mkdir()
    return root


def test_meshes_become_samples_of_their_surface(meshes):
    assert detect(meshes).name == "modelnet-off"
    clouds = read_modelnet_meshes(meshes)
    assert clouds.class_names == ("bed", "dresser")
    assert clouds.labels.tolist() == [0] * 4 + [1] * 4
    assert clouds.splits == ("train", "train", "test", "test") * 2
    assert clouds.ids[:2] == ("bed/train/bed_0000.off", "bed/train/bed_0001.off")
    for cloud, label, number in zip(clouds.clouds, clouds.labels, [0, 1] * 4, strict=True):
        size = np.array([(3, 4, 1), (1, 2, 5)][label])
        away = np.abs(cloud - [10 * number, 0, 0]) / (size / 2)
        assert cloud.shape == (2048, 3)
        np.testing.assert_allclose(away.max(axis=1), 1, atol=1e-5)  # on a face of the brick
        # By area: a pair of faces gets its share of the points, here within five sigma.
        areas = size.prod() / size
        share = (np.abs(away - 1) < 1e-5).mean(axis=0)
        sigma = np.sqrt(areas / areas.sum() / 2048)
        assert (np.abs(share - areas / areas.sum()) < 5 * sigma).all()
    assert [set(read_modelnet_meshes(meshes, part).splits) for part in ("train", "test")] == [
        {"train"},
        {"test"},
    ]


def test_convention_meshes_are_z_up_and_stay_so(meshes):
    clouds = read_modelnet_meshes(meshes)
    spans = [np.ptp(cloud, axis=0).argmax() for cloud in clouds.clouds]
    assert spans == [1] * 4 + [2] * 4  # the bed is long, the dresser tall


def test_samples_follow_from_the_name_alone(meshes):
    first = read_modelnet_meshes(meshes)
    (meshes / "bed" / "train" / "bed_0000.off").unlink()
    rest = read_modelnet_meshes(meshes)
    by_id = dict(zip(first.ids, first.clouds, strict=True))
    for name, cloud in zip(rest.ids, rest.clouds, strict=True):
        np.testing.assert_array_equal(cloud, by_id[name])
    assert rest.checksum != first.checksum
    # Two bricks of one size at two places are not sampled at the same spots.
    one, two = (by_id[f"bed/test/bed_000{i}.off"] for i in range(2))
    assert np.abs(one + np.array([10, 0, 0]) - two).max() > 0.1


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("bed/train/bed_0000.off", "\0\1\2", r"bed_0000\.off: cannot be read as OFF"),
        ("bed/train/bed_0000.off", "OFF\n3 1 0\n0 0 0\n1 1 1\n2 2 2\n3 0 1 2\n",
         r"bed_0000\.off: has no face with an area"),
        ("bunk/train/a.off", "", r"bunk.*: is not in <class>/<train\|test>/ of a class of Model"),
        ("bed/loose.off", "", r"loose\.off: is not in <class>/<train\|test>/"),
    ],
    ids=["no OFF", "no area", "another class", "no split"],
)  # fmt: skip
def test_bad_meshes_are_refused_in_one_line(meshes, name, content, message):
    (meshes / name).parent.mkdir(parents=True, exist_ok=True)
    (meshes / name).write_text(content)
    with refused(message):
        read_modelnet_meshes(meshes)


def test_clouds_are_turned_z_up_and_split_by_the_lists(tmp_path, rng):
    names = {"train": ["bed_0001", "night_stand_0001"], "test": ["bed_0002"]}
    stored = {}
    for split, own in names.items():
        (tmp_path / f"modelnet40_{split}.txt").write_text("\n".join(own) + "\n")
        for name in own:
            rows = stored[name] = rng.random((60, 6)).astype(np.float32)
            folder = tmp_path / name.rpartition("_")[0]
            folder.mkdir(exist_ok=True)
            lines = (",".join(f"{value:.6f}" for value in row) for row in rows)
            (folder / f"{name}.txt").write_text("\n".join(lines))
    for name in ("modelnet40_shape_names.txt", "filelist.txt"):
        (tmp_path / name).write_text("bed\nnight_stand\n")
    for split, own in names.items():
        clouds = load_clouds(tmp_path, split=split, num_points=None)
        assert [id.rpartition("/")[2] for id in clouds.ids] == [f"{name}.txt" for name in own]
        for name, label, cloud in zip(own, clouds.labels, clouds.points, strict=True):
            assert clouds.class_names[label] == name.rpartition("_")[0]
            x, y, z = stored[name][:, :3].T
            np.testing.assert_allclose(cloud, np.stack([x, -z, y], axis=1), atol=1e-6)
    # Not file by file, which would leave y up.
    assert list_clouds([tmp_path]) == [tmp_path]
    assert len(read_listed(tmp_path)) == 3
    for name in ("x" * 300 + "_1", "bed_" + "1" * 300, "../up_1"):
        (tmp_path / "modelnet40_test.txt").write_text(name)
        with refused("a path, too long|no such file", tmp_path):
            load_clouds(tmp_path)
    (tmp_path / "modelnet40_test.txt").write_text("bed_0002")
    (tmp_path / "bed" / "bed_0002.txt").unlink()
    with refused("bed_0002.txt, and there is no such file", tmp_path):
        load_clouds(tmp_path)
