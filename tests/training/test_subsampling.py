import numpy as np
import pytest

from qs3.io.clouds import UnlabelledClouds, numbered
from qs3.io.preparation import resample, unit_ball
from qs3.training import prepared
from qs3.training.prepared import prepare_clouds


def prepare(points, count, cache=None):
    clouds = UnlabelledClouds(points, numbered(len(points)))
    return prepare_clouds(clouds, count, cache=cache)


def subsample(points, count, cache=None):
    return prepare(points, count, cache).chosen(slice(None))


@pytest.fixture
def clouds(rng):
    points = rng.normal(size=(5, 300, 3)).astype(np.float32)
    points[1] *= (1, 1, 0.01)
    points[2, 100:] = points[2, :200]  # repeated points tie
    points[3] = np.round(points[3])  # a grid ties everywhere
    points[4] = 0.5
    return points


@pytest.mark.parametrize("count", [1, 64, 299, 300, 301, 650])
def test_subsampled_and_normalised_is_what_evaluation_reads(clouds, count):
    """`load_clouds` subsamples cloud by cloud, then the network gets the unit ball."""
    expected = np.stack([resample(cloud, count) for cloud in clouds])
    assert np.array_equal(subsample(clouds, count), expected)
    assert np.array_equal(prepare(clouds, count).points, unit_ball(expected))


def test_choice_is_made_once(clouds, tmp_path, monkeypatch):
    first = subsample(clouds, 50, tmp_path)
    assert [path.suffix for path in tmp_path.iterdir()] == [".safetensors"]

    def forbidden(points, num_points):
        raise AssertionError("made again")

    monkeypatch.setattr(prepared, "farthest_point_sample", forbidden)
    assert np.array_equal(subsample(clouds, 50, tmp_path), first)
    for other, count in ((clouds, 51), (clouds + 1, 50), (clouds[:4], 50)):
        with pytest.raises(AssertionError, match="made again"):
            subsample(other, count, tmp_path)


@pytest.mark.parametrize("damage", [lambda b: b"", lambda b: b[:-7], lambda b: b[:-1] + b"\x07"])
def test_damaged_choice_is_made_again(clouds, tmp_path, damage):
    first = subsample(clouds, 50, tmp_path)
    (path,) = tmp_path.iterdir()
    path.write_bytes(damage(path.read_bytes()))
    assert np.array_equal(subsample(clouds, 50, tmp_path), first)
    assert np.array_equal(subsample(clouds, 50, tmp_path), first)
