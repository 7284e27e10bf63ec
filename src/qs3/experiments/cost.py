"""What a grid of runs takes, from a few scans and a few steps of each kind that are measured."""

from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np

from qs3.adaptation.names import split_method
from qs3.experiments.domains import DataSet, Part
from qs3.experiments.runs import ORDINARY, Run
from qs3.experiments.setup import Setup
from qs3.io.clouds import PointClouds, numbered
from qs3.store.manifest import finished_shards
from qs3.store.plan import Plan
from qs3.training.config import TrainSettings
from qs3.training.plan import Cost, epoch_steps, round_steps
from qs3.training.plan import measure as measure_steps

_CLASSES = 10
_KEPT = 0.5
"""Share of its pool that a round is taken to keep, as SPST and QBST do on D at ``laptop``."""


def measure(
    setup: Setup, left: Sequence[Run], plans: Mapping[str, Plan]
) -> tuple[float, dict[str, float]]:
    """Estimate what is left, from a few timed scans and a few timed steps of each kind.

    Returns:
        Processor seconds, of runs on a GPU those of the clock: of all scans, and of each run by its
        name.
    """
    steps = {
        network: step_costs(
            [run for run in left if run.network == network],
            setup.scale.train_with(setup.threads, network=network),
            setup.scale.data_points,
        )
        for network in dict.fromkeys(run.network for run in left)
    }
    expected, trained = {}, set()
    for run in left:
        source, target, test = (_size(part, plans) for part in run.parts(setup.own))
        # One training of the source alone serves several test sets.
        again = run.folder in trained
        trained.add(run.folder)
        clouds = (source, target, test)
        expected[run.name] = run_seconds(run, clouds, steps[run.network], only_scores=again)
    return 0.0, expected


def scans_left(plan: Plan, path: Path) -> int:
    """Return how many scans of a work list are not there, in a data set that may be begun."""
    return plan.rows - sum(len(plan.rows_of(s)) for s in finished_shards(path, plan.shards))


def step_costs(runs: Iterable[Run], settings: TrainSettings, points: int) -> dict[str, Cost]:
    """Measure each method of some runs of one network, on spheres of so many points."""
    each = {"source-only": settings}
    each |= {split_method(run.kind.method)[0]: run.train for run in runs}
    clouds = np.random.default_rng(0).normal(size=(settings.batch_size, points, 3))
    clouds /= 2 * np.linalg.norm(clouds, axis=2, keepdims=True)
    labels = np.arange(len(clouds)) % _CLASSES
    classes = tuple(map(str, range(_CLASSES)))
    source = PointClouds(clouds.astype(np.float32), labels, classes, numbered(len(clouds)))
    return {
        name: measure_steps(name, source, source.without_labels(), own)
        for name, own in each.items()
    }


def run_seconds(
    run: Run, clouds: tuple[int, int, int], costs: Mapping[str, Cost], only_scores: bool = False
) -> float:
    """Estimate the seconds of a run; a round is taken to keep half of the clouds it chooses from.

    Args:
        run: The run.
        clouds: Numbers of clouds to learn from, to adapt to, to score on.
        costs: What each method takes.
        only_scores: Whether its network is there, and nothing but its scores is missing.
    """
    settings, rounds, (source, target, test) = run.train, run.self_training, clouds
    base, plain = split_method(run.kind.method)[0], costs["source-only"]
    judged = test + source + (0 if rounds is None else target)
    seconds = judged * (plain.preparation + plain.look)
    if only_scores:
        return seconds
    seconds += (source + target) * plain.preparation
    looks = 1
    if not run.kind.warm_up:
        learnt = source - int(settings.holdout * source)
        seconds += settings.epochs * epoch_steps(base, settings, learnt, target) * costs[base].step
        if settings.validate_every:
            looks = -(-settings.epochs // settings.validate_every)
    if rounds is not None:
        kept = rounds.threshold_share or _KEPT
        domains = 2 if rounds.source_loss else 1
        seconds += round_steps(rounds, settings, target, kept) * domains * plain.step
        looks = 2 * rounds.rounds
    scored = 0 if run.row == ORDINARY else looks * test  # of each checkpoint
    return seconds + (looks * (source + target) + scored) * plain.look


def _size(part: Part | None, plans: Mapping[str, Plan]) -> int:
    """Clouds of a part of a data set; where nobody has counted them, a thousand."""
    if part is None:
        return 0
    if isinstance(part.data, DataSet):
        plan = plans[part.data.name]
        count = sum(item.split == part.split for item in plan.items) * plan.settings.scans_per_mesh
        return count * (3 if part.cloud == "all" else 1)
    return 1000 if part.count is None else part.count
