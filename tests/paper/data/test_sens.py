"""The reader of `.sens` files, against files written from the description of the format."""

import tracemalloc
import zlib
from pathlib import Path

import numpy as np
import pytest

from qs3.errors import InputError
from qs3.geometry import look_at
from qs3.paper.data.sens import read_depth_frames, read_sens_header

from ...clouds.hostile import refused
from .writers import LOST, Sens, camera_matrix

SIZE = (16, 12)


def small(frames: int = 4, **changes: object) -> Sens:
    rng = np.random.default_rng(1)
    depth = [rng.integers(0, 5000, SIZE[::-1], dtype=np.uint16) for _ in range(frames)]
    poses = [look_at(np.array([1.0 + i, 2, 3]), np.zeros(3)) for i in range(frames)]
    sens = Sens(depth, poses, SIZE, camera_matrix(14.0, SIZE))
    for name, value in changes.items():
        setattr(sens, name, value)
    return sens


@pytest.mark.parametrize("compression", [0, 1])
@pytest.mark.parametrize("every", [1, 3, 10])
def test_frames_come_back(tmp_path: Path, compression: int, every: int) -> None:
    sens = small(frames=7, compression=compression)
    frames = list(read_depth_frames(sens.write(tmp_path / "a.sens"), every))
    assert [frame.index for frame in frames] == list(range(0, 7, every))
    for frame in frames:
        np.testing.assert_array_equal(frame.steps, sens.depth[frame.index])
        np.testing.assert_allclose(frame.camera_to_world, sens.poses[frame.index], atol=1e-6)


def test_header_comes_back(tmp_path: Path) -> None:
    sens = small(shift=2000.0, color_intrinsic=2 * np.eye(4))
    header = read_sens_header(sens.write(tmp_path / "a.sens"))
    assert (header.num_frames, header.depth_shift, header.depth_size) == (4, 2000.0, SIZE)
    np.testing.assert_allclose(header.depth_intrinsic, sens.depth_intrinsic[:3, :3])


@pytest.mark.parametrize("lost", [LOST, np.full((4, 4), np.inf), np.zeros((4, 4))])
def test_a_lost_pose_is_none(tmp_path: Path, lost: np.ndarray) -> None:
    sens = small()
    sens.poses = [sens.poses[0], lost, *list(sens.poses)[2:]]
    frames = list(read_depth_frames(sens.write(tmp_path / "a.sens")))
    assert [frame.camera_to_world is None for frame in frames] == [False, True, False, False]


def faulty_pose(value: np.ndarray) -> Sens:
    sens = small()
    sens.poses = [*list(sens.poses)[:3], value]
    return sens


NAN = np.eye(4)
NAN[1, 3] = np.nan
BAD_HEADERS = {
    "version": (small(version=5), "version 4"),
    "one frame more": (small(announced=5, tail=b""), "cut off"),
    "name beyond the file": (small(name_length=2**40), "cut off"),
    "occi": (small(compression=2), "occi_ushort"),
    "NaN pose": (faulty_pose(NAN), "pose of frame 3"),
    "scaled pose": (faulty_pose(np.diag([2.0, 2, 2, 1])), "pose of frame 3"),
    "mirrored pose": (faulty_pose(np.diag([-1.0, 1, 1, 1])), "pose of frame 3"),
    "another size": (small(depth_size=(15, 12)), "does not unpack to 15×12"),
}


@pytest.mark.parametrize("fault", BAD_HEADERS)
def test_a_bad_file_is_one_line(tmp_path: Path, fault: str) -> None:
    sens, message = BAD_HEADERS[fault]
    path = sens.write(tmp_path / "a.sens")
    with refused(message, path):
        list(read_depth_frames(path))


@pytest.mark.parametrize("every", [1, 3])
def test_a_cut_file_is_refused(tmp_path: Path, every: int) -> None:
    content = small(tail=b"").content()
    path = tmp_path / "a.sens"
    for size in range(1, len(content), 97):
        path.write_bytes(content[:size])
        with refused("cut off|does not unpack", path):
            list(read_depth_frames(path, every))


def test_a_bomb_is_not_unpacked(tmp_path: Path) -> None:
    """24 MB of zeros packed to less than a depth image."""
    size = (512, 512)
    bomb = zlib.compress(bytes(24 * 2**20), 9)
    sens = small(frames=1, depth_size=size, depth=[np.zeros(size, np.uint16)])
    path = sens.write(tmp_path / "a.sens", [bomb])
    tracemalloc.start()
    with pytest.raises(InputError, match="does not unpack to 512×512"):
        list(read_depth_frames(path))
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 3 * 2**20


@pytest.mark.parametrize(
    "blob", [b"", b"not zlib", zlib.compress(bytes(383)), zlib.compress(bytes(384))[:-5]]
)
def test_damaged_depth_is_refused(tmp_path: Path, blob: bytes) -> None:
    sens = small()
    path = sens.write(tmp_path / "a.sens", [*sens.blobs()[:3], blob])
    frames = read_depth_frames(path)
    assert [next(frames).index for _ in range(3)] == [0, 1, 2]
    with pytest.raises(InputError, match=r"frame 3|unpack"):
        next(frames)
