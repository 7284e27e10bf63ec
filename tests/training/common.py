"""What the tests of trainings share: tiny domains and settings, stops, comparisons."""

import dataclasses
import json

import dann  # noqa: F401  # so that fit knows the method dann:DANN
import numpy as np
import torch

from qs3.clouds.types import PointClouds
from qs3.runs import SelfTrainingSettings, history

TRAIN = {
    "model_settings": {"channels": (16, 16, 32), "hidden": (16,), "transforms": False},
    "num_points": 64,
    "epochs": 4,
    "batch_size": 8,
    "learning_rate": 1e-2,
    "accelerator": "cpu",
    "threads": 1,
}
"""Of a small PointNet that tells the shapes of `make_clouds` apart in seconds."""
SWITCHES = SelfTrainingSettings(
    rounds=2, epochs=2, teacher="average", teacher_decay=0.5, threshold_share=0.5
)
"""Rounds as those of the preset gentle, fewer and shorter."""
CLOCK = {"seconds", "cpu_seconds", "samples_per_second"}


class Stop(Exception):  # noqa: N818
    """Ends a run from a callback, as a kill would."""


def make_clouds(
    count=24, seed=0, noise=0.0, names=("ball", "disc", "rod"), classes=3, points=64
) -> PointClouds:
    """Balls, discs and rods, in turn."""
    rng = np.random.default_rng(seed)
    labels = np.arange(count) % classes
    shape = np.array([[1, 1, 1], [1, 1, 0.1], [0.1, 0.1, 1]])[labels]
    xyz = rng.normal(size=(count, points, 3)) * shape[:, None]
    xyz += noise * rng.normal(size=xyz.shape)
    ids = tuple(f"{seed}-{i}" for i in range(count))
    return PointClouds(xyz.astype(np.float32), labels, tuple(names), ids)


def stop_at(call):
    """A callback that ends a training at its n-th call; ``seen`` is what it was told."""

    def callback(record, method):
        callback.seen.append(record)
        if len(callback.seen) == call:
            raise Stop

    callback.seen = []
    return callback


def same(a, b):
    """Whether two networks, or their states, have the same bits."""
    a, b = (part if isinstance(part, dict) else part.state_dict() for part in (a, b))
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


def plain(records):
    """Records, or lines of a history, without what a clock tells."""
    rows = [row if isinstance(row, dict) else dataclasses.asdict(row) for row in records]
    return [{name: value for name, value in row.items() if name not in CLOCK} for row in rows]


def history_of(run_dir):
    return [json.loads(line) for line in (run_dir / history.HISTORY).read_text().splitlines()]
