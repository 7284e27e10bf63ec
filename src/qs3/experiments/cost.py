"""What a grid of runs takes, from a few steps of each kind that are measured."""

from collections.abc import Iterable, Mapping

import numpy as np

from qs3.adaptation import method_class
from qs3.adaptation.names import split_method
from qs3.experiments.runs import ORDINARY, Run
from qs3.io.clouds import PointClouds, numbered
from qs3.training.batches import count_batches
from qs3.training.config import TrainSettings
from qs3.training.plan import Cost, measure

_CLASSES = 10


def step_costs(runs: Iterable[Run], settings: TrainSettings, points: int) -> dict[str, Cost]:
    """Measure each method of some runs of one network, on spheres of so many points."""
    each = {"source-only": settings}
    each |= {split_method(run.kind.method)[0]: run.train for run in runs}
    clouds = np.random.default_rng(0).normal(size=(settings.batch_size, points, 3))
    clouds /= 2 * np.linalg.norm(clouds, axis=2, keepdims=True)
    labels = np.arange(len(clouds)) % _CLASSES
    classes = tuple(map(str, range(_CLASSES)))
    source = PointClouds(clouds.astype(np.float32), labels, classes, numbered(len(clouds)))
    return {name: measure(name, source, source.without_labels(), own) for name, own in each.items()}


def run_seconds(
    run: Run,
    clouds: tuple[int, int, int],
    costs: Mapping[str, Cost],
    only_scores: bool = False,
) -> float:
    """Estimate the seconds of a run; a round is taken to keep every cloud that it may.

    Args:
        run: The run.
        clouds: Numbers of clouds to learn from, to adapt to, to score on.
        costs: What each method takes.
        only_scores: Whether its network is there, and nothing but its scores is missing.
    """
    settings, rounds, (source, target, test) = run.train, run.self_training, clouds
    base, size, plain = split_method(run.kind.method)[0], settings.batch_size, costs["source-only"]
    judged = test + source + (0 if rounds is None else target)
    seconds = judged * (plain.preparation + plain.look)
    if only_scores:
        return seconds
    seconds += (source + target) * plain.preparation
    looks = 1
    if not run.kind.warm_up:
        batches = count_batches(source - int(settings.holdout * source), size)
        if method_class(base).uses_target:
            batches = max(batches, count_batches(target, size))
        seconds += settings.epochs * batches * costs[base].step
        if settings.validate_every:
            looks = -(-settings.epochs // settings.validate_every)
    if rounds is not None:
        kept = int(target * (rounds.threshold_share or 1))
        batches = rounds.steps_per_epoch or count_batches(kept, size)
        domains = 2 if rounds.source_loss else 1
        seconds += rounds.rounds * rounds.epochs * batches * domains * plain.step
        looks = 2 * rounds.rounds
    scored = 0 if run.row == ORDINARY else looks * test  # of each checkpoint
    return seconds + (looks * (source + target) + scored) * plain.look
