"""NYU Depth v2: a small file of its very layout whose scene is known."""

import json

import h5py
import numpy as np
import pandas as pd
import pytest
import trimesh
from scipy.io import savemat

from qs3.errors import InputError
from qs3.objects.run import OutputSettings
from qs3.paper.data.nyuv2 import FILE, Nyuv2Settings, extract_nyuv2, list_nyuv2

from ...clouds.hostile import refused
from ...objects.depth_scene import box, cast, off_surface, thing

WORDS = ["wall", "floor", "sofa chair", "night stand", "light", "picture"]
WALL, FLOOR, CHAIR, STAND, LIGHT, _ = range(1, 7)
EYE = np.array([0.3, -2.4, 1.5])
TURN = np.radians(30.0)


def placed(shift=(0.0, 0.0, 0.0)) -> trimesh.Trimesh:
    mesh = thing()
    c, s = np.cos(TURN), np.sin(TURN)
    mesh.vertices = mesh.vertices @ np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]]) + shift
    return mesh


def camera(down: float, roll: float) -> np.ndarray:
    """OpenCV camera to world as a rotation; it looks along y, tilted down and rolled."""
    a, b = np.radians([down, roll])
    level = np.array([[1.0, 0, 0], [0, 0, 1], [0, -1, 0]])
    pitch = np.array([[1, 0, 0], [0, np.cos(a), np.sin(a)], [0, -np.sin(a), np.cos(a)]])
    turn = np.array([[np.cos(b), -np.sin(b), 0], [np.sin(b), np.cos(b), 0], [0, 0, 1]])
    return level @ pitch @ turn


def photograph(parts, rotation):
    """Depth, label and instance [480 640], by the toolbox's own formula: pixels from 1, y flipped.

    ``parts`` are mesh, label and instance.
    """
    mesh = trimesh.util.concatenate([part[0] for part in parts])
    numbers = [part[1:] for part in parts for _ in part[0].faces]
    column, row = np.meshgrid(np.arange(1, 641), np.arange(1, 481))
    x3, y3 = (column - 325.58244941119034) / 518.8579, (row - 253.73616334) / 519.46961
    rays = np.stack([x3, y3, np.ones(x3.shape)], axis=-1).reshape(-1, 3)
    depth, face = cast(mesh, rays, rotation, EYE)
    labels, instances = np.array([*numbers, (0, 0)])[face].T  # −1 is no face
    return [image.reshape(480, 640) for image in (depth, labels, instances)]


def write(path, frames) -> None:
    """Frames of depth, label and instance as MATLAB's save -v7.3 lays them out."""
    with h5py.File(path, "w", userblock_size=512) as file:
        stacks = [np.stack([image.T for image in images]) for images in zip(*frames, strict=True)]
        kinds = (("rawDepths", "f4"), ("labels", "u2"), ("instances", "u1"))
        for (name, kind), stack in zip(kinds, stacks, strict=True):
            file.create_dataset(name, data=stack.astype(kind), chunks=(1, 160, 160), compression=3)
        scenes = [f"office_{i:04d}" for i in range(len(frames))]
        for name, texts in (("names", WORDS), ("scenes", scenes)):
            cells = []
            for number, text in enumerate(texts):
                letters = np.array([[ord(letter)] for letter in text], np.uint16)
                cell = file.create_dataset(f"#refs#/{name}{number}", data=letters)
                cells.append(cell.ref)
            file[name] = np.array(cells, dtype=h5py.ref_dtype).reshape(1, -1)
    with path.open("r+b") as handle:
        handle.write(b"MATLAB 7.3 MAT-file, Platform: GLNXA64".ljust(116) + b"\0" * 8 + b"\0\2IM")


ROTATION = camera(28.0, 4.0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Frames: all of it; a second chair that the border cuts; no floor labelled."""
    folder = tmp_path_factory.mktemp("nyu")
    floor, wall = box((8, 8, 0.1), (-4, -4, -0.1)), box((8, 0.1, 3), (-4, 2.0, 0))
    side, lamp = box((0.1, 8, 3), (-2.5, -4, 0)), box((0.1, 0.1, 0.1), (-0.8, 0.5, 0.9))
    room = [(floor, FLOOR, 1), (wall, WALL, 1), (side, WALL, 2), (lamp, LIGHT, 1)]
    stand = box((0.4, 0.4, 0.5), (0.9, 0.2, 0.0))
    whole = photograph([*room, (placed(), CHAIR, 1), (stand, STAND, 1)], ROTATION)
    two = [(placed(), CHAIR, 1), (placed((1.45, 0.0, 0.0)), CHAIR, 2)]
    halved = photograph([*room, *two], ROTATION)
    bare = [part if part[1] != FLOOR else (floor, 6, 1) for part in room]
    unlabelled = photograph([*bare, (placed(), CHAIR, 1)], ROTATION)
    write(folder / FILE, [whole, halved, unlabelled])
    savemat(folder / "splits.mat", {"trainNdxs": [[1], [3]], "testNdxs": [[2]]})
    return folder


def run(folder, out, workers=0, num_points=100_000, **settings):
    """What was told, and a row per object."""
    output = OutputSettings(str(out), num_points=num_points, workers=workers)
    report = extract_nyuv2(folder, output, Nyuv2Settings(**settings))
    rows = pd.concat([pd.read_parquet(path) for path in sorted(out.glob("*.parquet"))])
    rows["points"] = [points.reshape(-1, 3) for points in rows["points"]]
    facts = pd.DataFrame([json.loads(text) for text in rows["drawn"]], index=rows["id"])
    return report, rows.set_index("id").join(facts.drop(columns="points"))


@pytest.fixture(scope="module")
def cut(folder, tmp_path_factory):
    return run(folder, tmp_path_factory.mktemp("out") / "data")


def test_objects_classes_facts_and_the_official_split(cut):
    report, rows = cut
    assert (report.objects, report.units, report.failed) == (5, 3, 0)
    assert rows["class_name"].to_dict() == {
        "nyu0001/003_01": "chair", "nyu0001/004_01": "cabinet", "nyu0002/003_01": "chair",
        "nyu0002/003_02": "chair", "nyu0003/003_01": "chair"}  # fmt: skip
    assert rows["split"].tolist() == ["train", "train", "test", "test", "train"]
    assert rows["raw"].tolist() == ["sofa chair", "night stand", *["sofa chair"] * 3]
    assert rows["scene"].tolist() == [f"office_000{i}" for i in (0, 0, 1, 1, 2)]
    assert rows["frame"].tolist() == [1, 1, 2, 2, 3]
    assert rows["floor_ok"].tolist() == [True] * 4 + [False]
    assert rows["cut"].tolist() == [0, 0, 0, 1, 0]
    # The stand is whole and near; smaller than half of any cabinet it is not.
    assert rows["strict"].tolist() == [True, True, True, False, False]
    assert rows["depth"].between(2.0, 3.5).all()


def test_convention_points_stand_on_the_thing_in_the_room_and_not_mirrored(cut):
    _, rows = cut
    for name, shift in (("1/003_01", 0.0), ("2/003_01", 0.0), ("2/003_02", 1.45)):
        mesh, cloud = placed((shift, 0.0, 0.0)), rows.loc[f"nyu000{name}", "points"]
        assert len(cloud) > 5000
        world = cloud[::20] + EYE * [1, 1, 0]  # the floor below the camera is the origin
        assert off_surface(mesh, world).max() < 0.002
        mirrored = world * [-1, 1, 1] + [2 * mesh.bounds.mean(axis=0)[0], 0, 0]
        assert off_surface(mesh, mirrored).mean() > 0.02
    whole = rows.loc["nyu0001/003_01", "points"]
    assert whole[:, 2].max() == pytest.approx(0.9, abs=0.002)


def test_without_a_floor_the_room_tells_which_way_is_up(cut):
    _, rows = cut
    cloud = rows.loc["nyu0003/003_01", "points"][::20]
    assert off_surface(placed(), cloud + EYE).max() < 0.03  # half a degree, from the camera
    assert cloud[:, 2].max() == pytest.approx(0.9 - EYE[2], abs=0.03)


def test_strict_ones_alone(folder, tmp_path, cut):
    _, strict = run(folder, tmp_path / "strict", strict=True)
    assert strict.index.tolist() == cut[1].index[cut[1]["strict"]].tolist()


def test_classes_of_ones_own_and_all_of_them(folder, tmp_path):
    _, of_user = run(folder, tmp_path / "own", num_points=64, classes=("picture", "chair"))
    assert set(of_user["class_name"]) == {"picture", "chair"}
    _, every = run(folder, tmp_path / "all", num_points=64, classes=("all",))
    assert set(every["class_name"]) == set(WORDS)
    with pytest.raises(InputError, match="none of its 6 classes"):
        run(folder, tmp_path / "none", num_points=64, classes=("bathtub",))


def test_other_files_are_refused_in_one_line(folder, tmp_path):
    with refused("[nN]o such file", FILE):
        list_nyuv2(tmp_path / FILE)
    (tmp_path / FILE).write_bytes(b"no HDF5")
    with refused("cannot be read as NYU Depth v2", FILE):
        list_nyuv2(tmp_path / FILE)
    with h5py.File(tmp_path / "other.mat", "w") as file:
        file["labels"] = np.zeros((2, 480, 640), np.uint8)
    with refused("names", "other.mat"):
        list_nyuv2(tmp_path / "other.mat")
    (tmp_path / FILE).write_bytes((folder / FILE).read_bytes())
    with h5py.File(tmp_path / FILE, "r+") as file:
        shape = (30_000, 640, 480)
        del file["instances"]
        file.create_dataset("instances", shape, "u1", chunks=(1, 160, 160), compression=3)
    with refused("data has 9216000000 bytes, more than the limit", FILE):
        list_nyuv2(tmp_path / FILE)
    (tmp_path / "splits.mat").write_bytes(bytes(3 << 20))
    with refused("its content has .* more than the limit", "splits.mat"):
        list_nyuv2(folder / FILE, tmp_path / "splits.mat")
    savemat(tmp_path / "splits.mat", {"trainNdxs": [[1], [2]], "testNdxs": [[2]]})
    with refused("all 3 frames, each once", "splits.mat"):
        list_nyuv2(folder / FILE, tmp_path / "splits.mat")
    savemat(tmp_path / "splits.mat", {"trainNdxs": [[1], [2]]})
    with refused("all 3 frames, each once", "splits.mat"):
        list_nyuv2(folder / FILE, tmp_path / "splits.mat")
