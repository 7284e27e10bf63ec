"""Tiny domains that a small PointNet tells apart in seconds."""

import numpy as np
import pytest

from qs3.io.clouds import PointClouds
from qs3.training import TrainSettings


def make_clouds(count=24, seed=0, noise=0.0, names=("ball", "disc", "rod")):
    """Balls, discs and rods of 64 points, in turn."""
    rng = np.random.default_rng(seed)
    labels = np.arange(count) % 3
    shape = np.array([[1, 1, 1], [1, 1, 0.1], [0.1, 0.1, 1]])[labels]
    points = rng.normal(size=(count, 64, 3)) * shape[:, None]
    points += noise * rng.normal(size=points.shape)
    ids = tuple(f"{seed}-{i}" for i in range(count))
    return PointClouds(points.astype(np.float32), labels, tuple(names), ids)


@pytest.fixture(scope="session")
def source():
    return make_clouds()


@pytest.fixture(scope="session")
def target():
    return make_clouds(count=30, seed=1, noise=0.1)


@pytest.fixture(scope="session")
def settings():
    return TrainSettings(
        model="pointnet",
        model_settings={"channels": (16, 16, 32), "hidden": (16,), "transforms": False},
        num_points=64,
        epochs=4,
        batch_size=8,
        learning_rate=1e-2,
        accelerator="cpu",
        threads=1,
        holdout=0.0,
    )
