"""Clouds that a run has seen are known by their exact points; others are not."""

import numpy as np
import pytest

from qs3.evaluation.records import DataRecord
from qs3.io.clouds import UnlabelledClouds, numbered
from qs3.training.prepared import prepare_clouds
from qs3.training.run import Run, caveats, checksums

DATA = DataRecord("a", "b", 1)


def ready(points, num_points=None):
    clouds = UnlabelledClouds(np.asarray(points), numbered(len(points)))
    return prepare_clouds(clouds, num_points or points.shape[1])


def run_of(source=(), target=()):
    return Run(
        method="qbst", selection="last", source=DATA, target=DATA, unknown_warm_up=False,
        source_clouds=tuple(source), target_clouds=tuple(target), rounds=(), seconds={},
    )  # fmt: skip


@pytest.fixture
def clouds(rng):
    """Forty objects of 200 points, each a metre from the camera and about as large."""
    size = rng.uniform(0.2, 1.0, size=(40, 1, 3))
    return (rng.normal(size=(40, 200, 3)) * size + [0, 0, 1.0]).astype(np.float32)


@pytest.mark.parametrize("count", [200, 64])  # a training on fewer points
def test_seen_clouds_are_marked(clouds, count):
    seen = checksums(ready(clouds, count))
    for cloud in clouds[:5]:
        test = ready(cloud[None], count)
        assert caveats(run_of(seen), test) == ("training clouds",)
        assert caveats(run_of(target=seen), test) == ("transductive",)
    assert caveats(run_of(seen, seen), ready(clouds, count)) == ("transductive", "training clouds")


def test_other_clouds_are_not(clouds):
    run = run_of(checksums(ready(clouds[:20])))
    assert caveats(run, ready(clouds[20:])) == ()
    assert caveats(run, ready(clouds[:20, :100])) == ()  # other samples of the same objects
    assert caveats(run, ready(clouds[:1] + np.float32(1e-4))) == ()
