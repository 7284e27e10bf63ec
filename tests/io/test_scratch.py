"""Clouds beyond memory lie on the disk, and nothing else is different."""

import errno

import numpy as np
import pytest

from qs3.errors import InputError
from qs3.io import scratch
from qs3.io.clouds import UnlabelledClouds
from qs3.io.load import load_clouds, load_unlabelled
from qs3.io.preparation import ROBUST
from qs3.training.prepared import prepare_clouds, require_finite

from ..stores import write_store


@pytest.fixture
def large(monkeypatch):
    monkeypatch.setattr(scratch, "LARGE", 100)


def on_disk(points):
    while points is not None and not isinstance(points, np.memmap):
        points = points.base
    return points is not None


@pytest.mark.parametrize("cloud", ["points", "all"])
def test_large_data_set_is_read_from_the_disk(tmp_path, monkeypatch, cloud):
    rows = [(i % 2, "train", 40) for i in range(5)]
    data = write_store(tmp_path / "set", ("bed", "chair"), rows, shards=3)
    known = load_clouds(data, num_points=None, cloud=cloud)
    hidden = load_unlabelled(data, num_points=None, cloud=cloud)
    monkeypatch.setattr(scratch, "LARGE", 100)
    clouds = load_clouds(data, num_points=None, cloud=cloud)
    assert on_disk(clouds.points) and not on_disk(known.points)
    assert np.array_equal(clouds.points, known.points)
    assert (clouds.ids, clouds.checksum) == (known.ids, known.checksum)
    targets = load_unlabelled(data, num_points=None, cloud=cloud)
    assert on_disk(targets.points)
    assert np.array_equal(targets.points, hidden.points)
    ready, wanted = (prepare_clouds(part, 16, ROBUST) for part in (clouds, known))
    assert on_disk(ready.order.index)
    assert np.array_equal(ready.points, wanted.points)


def test_clouds_of_several_sizes_are_spooled(rng):
    spool, clouds = scratch.Spool(), [rng.random((n, 3), np.float32) for n in (3, 1, 4)]
    spool.extend(clouds[:2])
    spool.extend(clouds[2:])
    assert len(spool) == 3
    assert all(np.array_equal(a, b) for a, b in zip(spool, clouds, strict=True))
    assert np.array_equal(spool[-1], clouds[-1])
    assert [len(cloud) for cloud in spool[1:]] == [1, 4]
    with pytest.raises(IndexError):
        spool[3]


def test_full_disk_is_told_in_one_line(monkeypatch, large):
    def full(*_):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr("os.posix_fallocate", full, raising=False)
    with pytest.raises(InputError, match="TMPDIR"):
        scratch.scratch_array((100, 9, 3))


def test_fault_beyond_the_first_block_is_found():
    points = np.zeros((600, 2, 3), np.float32)
    points[555, 1, 2] = np.nan
    clouds = UnlabelledClouds(points, tuple(map(str, range(600))))
    with pytest.raises(InputError, match="cloud 555 "):
        require_finite(clouds.points, clouds.ids)
    require_finite(points[:0], ())
