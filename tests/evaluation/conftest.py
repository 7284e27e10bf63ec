"""Records to test with."""

import dataclasses
from collections.abc import Callable

import numpy as np
import pytest

from qs3.evaluation.records import DataRecord, RunRecord, score

RECORD = RunRecord(
    method="qbst",
    model="dgcnn",
    settings={"theta": 0.8, "seed": 0, "layers": [64, 64]},
    source=DataRecord("cad", "a" * 64, 10, "train", "points"),
    target=DataRecord("rooms", "b" * 64, 4),
    test=DataRecord("rooms", "b" * 64, 4),
    seed=0,
    selection="last",
    scores=score(np.array([0, 0, 1]), np.array([0, 1, -1]), ["bed", "sofa", "table"]),
    seconds={"total": 2.5},
    versions={"numpy": "2"},
    hardware={"cpu": "x", "cores": 2, "gpus": []},
    rounds=({"round": 1, "selected": {"bed": 3}},),
    marks=("transductive",),
)


@pytest.fixture
def record() -> RunRecord:
    return RECORD


@pytest.fixture
def with_accuracy() -> Callable[..., RunRecord]:
    """Make a record of a seed with a stated accuracy."""

    def make(seed: int, accuracy: float, **changes) -> RunRecord:
        scores = dataclasses.replace(RECORD.scores, accuracy=accuracy, class_mean_accuracy=0.5)
        settings = {**RECORD.settings, "seed": seed}
        return dataclasses.replace(
            RECORD, **({"seed": seed, "scores": scores, "settings": settings} | changes)
        )

    return make
