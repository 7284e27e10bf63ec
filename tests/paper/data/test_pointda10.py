import h5py
import numpy as np
import pytest

from qs3.clouds.load import detect, load_clouds
from qs3.clouds.preparation import unit_ball
from qs3.errors import InputError
from qs3.meshes.classes import POINTDA10
from qs3.paper.data.pointda10 import FORMAT, read_pointda10


def standing(rng, count=2048):
    """A lamp that stands upright, z up: wide foot below, shade on an arm along +x, cord to +y."""
    foot = np.c_[rng.normal(0, 0.3, (count // 2, 2)), rng.uniform(0, 0.1, count // 2)]
    arm = np.c_[rng.uniform(0, 0.8, count // 4), np.zeros(count // 4), np.full(count // 4, 2.0)]
    rest = count - len(foot) - len(arm)
    cord = np.c_[np.zeros(rest), rng.uniform(0, 1.5, rest), np.full(rest, 0.5)]
    return rng.permutation(np.concatenate([foot, arm, cord]))


def parts_of(cloud):
    """Where foot, arm and cord of a lamp lie, whatever its size: the arm is what is highest."""
    low, high = cloud[:, 2].min(), cloud[:, 2].max()
    height = (cloud[:, 2] - low) / (high - low)
    assert (height < 0.1).mean() > 0.4, "the foot is not below"
    return cloud[height < 0.1].mean(0), cloud[height > 0.9].mean(0), cloud[abs(height - 0.25) < 0.1]


def release(root, rng, classes=("chair", "plant"), splits=("train", "test")):
    """PointDA-10 as it is released; every object is the same lamp that stands upright."""
    lamp = standing(rng)
    x, y, z = lamp.T
    y_up = np.stack([x, z, -y], axis=1)  # ShapeNet: the lamp turned, seen along −z from the front
    swapped = np.stack([x, z, y], axis=1)  # ScanNet: the axes of a z-up scene written (x, z, y)
    for name in classes:
        for part in splits:
            for domain, cloud in (
                ("modelnet", lamp),
                ("shapenet", (lamp if name == "plant" else y_up)[:1024]),
            ):
                folder = root / domain / name / part
                folder.mkdir(parents=True)
                np.save(folder / f"{name}_0001.npy", cloud)
    (root / "scannet").mkdir()
    labels = [POINTDA10.index(name) for name in classes]
    colour = rng.uniform(-0.5, 0.5, (len(classes), 2048, 3))
    data = np.concatenate([np.stack([swapped] * len(classes)), colour], axis=2)
    for part in splits:
        with h5py.File(root / "scannet" / f"{part}_0.h5", "w") as file:
            file["data"], file["label"] = data, np.array(labels, dtype=np.int32)
        (root / "scannet" / f"{part}_files.txt").write_text(f"./{part}_0.h5\n")
    return lamp


@pytest.mark.parametrize("domain", ["modelnet", "shapenet", "scannet"])
def test_convention_every_domain_stands_upright_and_only_scannet_is_mirrored(tmp_path, rng, domain):
    lamp = release(tmp_path, rng)
    clouds = read_pointda10(tmp_path / domain)
    assert sorted(POINTDA10[i] for i in clouds.labels) == ["chair", "chair", "plant", "plant"]
    mirrored = domain == "scannet"
    expected = lamp * [1, -1, 1] if mirrored else lamp
    expected = unit_ball(expected[None, : 1024 if domain == "shapenet" else None])[0]
    for cloud in clouds.clouds:
        foot, arm, cord = parts_of(cloud)
        assert arm[0] > foot[0] + 0.1
        assert np.sign(cord[:, 1].mean() - foot[1]) == (-1 if mirrored else 1)
        np.testing.assert_allclose(cloud, expected, atol=1e-6)


def published_alignment(cloud, turn):
    """The published rule in its own words: mean, farthest norm, rows times a matrix of −90°."""
    cloud = cloud - cloud.mean(axis=0)
    cloud = cloud / np.sqrt((cloud**2).sum(axis=1)).max()
    c, s = np.cos(-np.pi / 2), np.sin(-np.pi / 2)
    return cloud @ np.array([[1, 0, 0], [0, c, -s], [0, s, c]]) if turn else cloud


def test_the_aligned_protocol_is_the_published_rule_with_its_plant_exception(tmp_path, rng):
    classes = ("bathtub", "plant", "table")
    for name in classes:
        for domain in ("modelnet", "shapenet"):
            (tmp_path / domain / name / "train").mkdir(parents=True)
    stored = rng.normal(size=(3, 3, 512, 3)) * [1, 2, 3] + 5
    for row, name in enumerate(classes):
        np.save(tmp_path / "modelnet" / name / "train" / "a.npy", stored[0, row])
        np.save(tmp_path / "shapenet" / name / "train" / "a.npy", stored[1, row])
    (tmp_path / "scannet").mkdir()
    with h5py.File(tmp_path / "scannet" / "train_0.h5", "w") as file:
        file["data"] = np.concatenate([stored[2], np.zeros_like(stored[2])], axis=2)
        file["label"] = [POINTDA10.index(name) for name in classes]
    for index, domain in enumerate(("modelnet", "shapenet", "scannet")):
        clouds = read_pointda10(tmp_path / domain, "train").clouds
        for row, name in enumerate(classes):
            turn = domain == "scannet" or (domain == "shapenet" and name != "plant")
            expected = published_alignment(stored[index, row], turn)
            np.testing.assert_allclose(clouds[row], expected, atol=1e-6)
            # The other sign, and the other choice about plants, would be far off.
            assert abs(clouds[row] - expected * [1, -1, -1]).max() > 0.3
            other = published_alignment(stored[index, row], not turn)
            assert abs(clouds[row] - other).max() > 0.3


def test_the_root_asks_for_one_domain(tmp_path, rng):
    root = tmp_path / "PointDA_data"
    release(root, rng)
    with pytest.raises(InputError, match=r"name one: .*/modelnet, .*/shapenet, .*/scannet"):
        read_pointda10(root)
    assert detect(root) is FORMAT
    for domain in ("modelnet", "shapenet", "scannet"):
        assert detect(root / domain) is FORMAT
        assert len(load_clouds(root / domain, split="test").ids) == 2
    # Under another name an npy tree does not tell its up axis.
    (root / "shapenet").rename(root / "other")
    assert detect(root / "other").name == "folder"
    with pytest.raises(InputError, match=r"no domain of PointDA-10; name a folder called modelnet"):
        read_pointda10(root / "other")
    (root / "shapenet").symlink_to(root / "other")
    assert len(read_pointda10(root / "shapenet").ids) == 4
