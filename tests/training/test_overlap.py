"""Clouds that a run has seen, written anew in any way; and others, which are not."""

from dataclasses import replace

import numpy as np
import pytest

from qs3.errors import InputError
from qs3.evaluation.records import DataRecord
from qs3.io.clouds import UnlabelledClouds, numbered
from qs3.training.overlap import caveats, seen_clouds, shapes
from qs3.training.prepared import prepare_clouds
from qs3.training.run import Run

DATA = DataRecord("a", "b", 1)


def ready(points, num_points=None):
    clouds = UnlabelledClouds(np.asarray(points), numbered(len(points)))
    return prepare_clouds(clouds, num_points or points.shape[1])


def run_of(source, target=((), ())):
    return Run(
        method="qbst", selection="last", source=DATA, target=DATA, unknown_warm_up=False,
        source_clouds=source[0], source_shapes=source[1], target_clouds=target[0],
        target_shapes=target[1], rounds=(), seconds={},
    )  # fmt: skip


@pytest.fixture
def clouds(rng):
    """Forty objects of 200 points, each a metre from the camera and about as large."""
    size = rng.uniform(0.2, 1.0, size=(40, 1, 3))
    return (rng.normal(size=(40, 200, 3)) * size + [0, 0, 1.0]).astype(np.float32)


REWRITTEN = {
    "as it is": lambda p, rng: p,
    "float64": lambda p, rng: p.astype(np.float64) * 1.0000001,
    "float16": lambda p, rng: p.astype(np.float16).astype(np.float32),
    "rounded": lambda p, rng: p.round(3),
    "moved": lambda p, rng: p + np.float32(1e-4),
    "noisy": lambda p, rng: p + rng.normal(scale=1e-4, size=p.shape),
    "another order": lambda p, rng: rng.permuted(p, axis=1) if p.ndim == 2 else p[:, ::-1],
    "another unit": lambda p, rng: 1000 * p,
}


@pytest.mark.parametrize("name", REWRITTEN)
def test_a_cloud_written_anew_is_known(clouds, rng, name):
    for count in (200, 64):  # a training on fewer points
        seen = seen_clouds(ready(clouds, count))
        for cloud in clouds[:5]:
            test = ready(REWRITTEN[name](cloud[None], rng))
            assert caveats(run_of(seen), test) == ("training clouds",)
            assert caveats(run_of(((), ()), seen), test) == ("transductive",)


def test_what_the_network_gets_is_known_too(clouds):
    prepared = ready(clouds, 64)
    test = prepared.chosen(slice(3, 4)) + np.float32(1e-4)
    assert caveats(run_of(seen_clouds(prepared)), ready(test)) == ("training clouds",)


def test_other_clouds_are_not(clouds):
    seen = seen_clouds(ready(clouds[:20]))
    assert caveats(run_of(seen), ready(clouds[20:])) == ()
    half = run_of(seen_clouds(ready(clouds[:20, :100])))
    assert caveats(half, ready(clouds[:20, 100:])) == ()  # other samples of the same objects
    flat = np.ones((2, 10, 3), np.float32)
    assert shapes(flat) == []
    assert caveats(run_of(seen_clouds(ready(flat[:1]))), ready(2 * flat)) == ()


def test_damaged_shapes_are_told(clouds):
    seen = seen_clouds(ready(clouds))
    for bad in ("", "00", "x" * 64, seen[1][0][:-1]):
        run = replace(run_of(seen), source_shapes=(bad,))
        with pytest.raises(InputError, match=r"shapes of clouds .* are damaged"):
            caveats(run, ready(clouds[:1] * 2))


@pytest.mark.slow
def test_no_false_mark_on_real_objects(shared_data):
    """The nearest two different objects are more than the tolerance apart."""
    from scipy.spatial import KDTree

    from qs3.training.overlap import TOLERANCE

    for name in ("modelnet10_1024.npz", "nyuv2_objects.npz"):
        points = np.load(shared_data / name)["points"].astype(np.float32)
        texts = shapes(points)
        rows = np.frombuffer(bytes.fromhex("".join(texts)), "<i2").reshape(len(texts), -1)
        nearest = KDTree(rows).query(rows, 2, p=np.inf)[0][:, 1] * 1e-4
        assert (nearest <= TOLERANCE).sum() == 0
