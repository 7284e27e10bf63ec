"""Clouds that a run has seen are known by their points and by their shape; others are not."""

import dataclasses

import numpy as np
import pytest

from qs3.clouds.load import load_clouds
from qs3.clouds.preparation import PAPER, ROBUST
from qs3.clouds.types import UnlabelledClouds, numbered
from qs3.evaluation.records import DataRecord
from qs3.runs.digests import checksums, shapes
from qs3.runs.overlap import caveats
from qs3.runs.run import Run
from qs3.training.prepared import prepare_clouds

DATA = DataRecord("a", "b", 1)


def ready(points, num_points=None, preparation=PAPER):
    clouds = UnlabelledClouds(np.asarray(points), numbered(len(points)))
    return prepare_clouds(clouds, num_points or points.shape[1], preparation)


def run_of(source=(), target=(), **shapes):
    return Run(
        method="qbst", selection="last", source=DATA, target=DATA, unknown_warm_up=False,
        source_clouds=tuple(source), target_clouds=tuple(target), rounds=(), seconds={}, **shapes,
    )  # fmt: skip


def run_on(prepared, role="source"):
    """A run of this release that has seen these clouds."""
    return run_of(
        **{role: checksums(prepared), f"{role}_shapes": tuple(shapes(prepared.clouds.points))}
    )


@pytest.fixture
def clouds(rng):
    """Forty objects of 200 points, each a metre from the camera and about as large."""
    size = rng.uniform(0.2, 1.0, size=(40, 1, 3))
    return (rng.normal(size=(40, 200, 3)) * size + [0, 0, 1.0]).astype(np.float32)


def rounded(step):
    """Round to a grid whose step is a share of the cloud's longest side."""

    def change(cloud, rng):
        size = float(np.ptp(cloud, axis=0).max()) * step
        return np.round(cloud / size) * size

    return change


COPIES = {
    "the same": lambda cloud, rng: cloud,
    "reordered": lambda cloud, rng: rng.permutation(cloud),
    "moved": lambda cloud, rng: cloud + rng.uniform(-3, 3, 3),
    "scaled": lambda cloud, rng: 1000 * cloud,
    "float16": lambda cloud, rng: cloud.astype(np.float16),
    "rounded to 1e-4": rounded(1e-4),
    "moved, reordered, rounded": lambda cloud, rng: rng.permutation(
        rounded(1e-4)(cloud, rng) + rng.uniform(-3, 3, 3)
    ),
    "repeats": lambda cloud, rng: rng.permutation(np.concatenate([cloud, cloud[:50]])),
}


@pytest.mark.parametrize("preparation", [PAPER, ROBUST], ids=["paper", "robust"])
@pytest.mark.parametrize("copy", COPIES)
def test_each_copy_of_a_seen_cloud_is_marked(clouds, rng, copy, preparation):
    seen = ready(clouds, 64, preparation)
    as_source, as_target = run_on(seen), run_on(seen, "target")
    for cloud in clouds:
        changed = COPIES[copy](cloud, rng).astype(np.float32)
        test = ready(changed[None], 64, preparation)
        assert caveats(as_source, test) == ("training clouds",)
        assert caveats(as_target, test) == ("transductive",)


def test_what_is_scored_beside_a_copy_does_not_hide_it(clouds, rng):
    run = run_on(ready(clouds[:20]))
    mixed = np.concatenate([clouds[20:], rng.permutation(clouds[3])[None]])
    assert caveats(run, ready(mixed)) == ("training clouds",)


@pytest.mark.parametrize("count", [200, 64])  # a training on fewer points
def test_runs_of_earlier_releases_know_the_points_alone(clouds, count):
    seen = checksums(ready(clouds, count))
    for cloud in clouds[:5]:
        assert caveats(run_of(seen), ready(cloud[None], count)) == ("training clouds",)
        assert caveats(run_of(target=seen), ready(cloud[None], count)) == ("transductive",)
    assert caveats(run_of(seen, seen), ready(clouds, count)) == ("transductive", "training clouds")
    assert caveats(run_of(seen), ready(clouds[:, ::-1], count)) == ()
    added = run_of(seen[5:], source_shapes=tuple(shapes(clouds[:1])))  # by rounds of this one
    assert caveats(added, ready(clouds[:1, ::-1], count)) == ("training clouds",)


def test_other_clouds_are_not(clouds):
    run = run_on(ready(clouds[:20]))
    assert caveats(run, ready(clouds[20:])) == ()
    assert caveats(run, ready(clouds[:20, :100])) == ()  # other samples of the same objects


def test_other_scans_of_one_part_that_lies_still_are_not(rng):
    """The same pixels with the noise of another frame, 0.5 % of the size: a D435 at 0.5 m."""
    part = rng.uniform(-0.05, 0.05, size=(1500, 3)) * [1, 0.6, 0.3]
    frames = (part + rng.normal(0, 0.0005, size=(60, 1500, 3))).astype(np.float32)
    run = run_on(ready(frames[:30]))
    assert caveats(run, ready(frames[30:])) == ()
    same = rng.permutation(frames[0])[None] + np.float32(0.2)
    assert caveats(run, ready(same)) == ("training clouds",)


def test_real_objects_differ_from_each_other(shared_data):
    clouds = load_clouds(shared_data / "modelnet10_1024.npz", num_points=None)
    clouds = clouds.select(np.arange(0, len(clouds), 16))
    half = clouds.select(np.arange(len(clouds)) % 2 == 0)
    rest = clouds.select(np.arange(len(clouds)) % 2 == 1)
    run = run_on(prepare_clouds(half, 64))
    assert caveats(run, prepare_clouds(rest, 64)) == ()
    turned = dataclasses.replace(half, points=half.points[:, ::-1] + np.float32(1))
    assert caveats(run, prepare_clouds(turned, 64)) == ("training clouds",)
