"""What a training would do and about how long it takes, before it is begun."""

import statistics
import time
from collections import Counter
from dataclasses import replace

import torch

from qs3.io.clouds import PointClouds, UnlabelledClouds
from qs3.models import PointClassifier
from qs3.structure import unstructure
from qs3.training.batches import count_batches
from qs3.training.config import SelfTrainingSettings, TrainSettings
from qs3.training.distributed import make_fabric
from qs3.training.job import fresh_model, make_method
from qs3.training.threads import threads, trial_step
from qs3.training.validation import held_out

_STEPS = 4
"""Timed steps; the first, which warms up, does not count."""


def describe_plan(
    method: str,
    source: PointClouds | None,
    target: UnlabelledClouds | None,
    settings: TrainSettings,
    rounds: SelfTrainingSettings | None,
    warm_up: bool = False,
) -> list[str]:
    """Return lines that say what would be trained, on how much, in how many steps and how long.

    The time is that of forward and backward passes alone, on this machine as busy as it is now;
    that of rounds is the most: every cloud of the target selected.

    Args:
        method: Method before the rounds, if there are any.
        source: Labelled clouds; None where rounds learn from the target alone.
        target: Clouds without labels.
        settings: How to train.
        rounds: How to train oneself; None without rounds.
        warm_up: Whether a network is given that takes the place of the training on the source.
    """
    lines, steps, classes = [], 0, 10
    if source is not None:
        held, classes = int(held_out(source, settings).sum()), len(source.class_names)
        counts = Counter(source.labels.tolist())
        each = ", ".join(f"{name} {counts[i]}" for i, name in enumerate(source.class_names))
        lines.append(f"source    {len(source)} clouds, {held} of them held out: {each}")
        batches = count_batches(len(source) - held, settings.batch_size)
        if not warm_up:
            steps = settings.epochs * batches
            size = settings.batch_size
            told = f"{settings.epochs} epochs of {batches} steps of {size} clouds: {steps}"
            lines.append(f"training  {method}, {told}")
    if target is not None:
        lines.append(f"target    {len(target)} clouds")
    if rounds is not None and target is not None:
        each = rounds.steps_per_epoch or count_batches(len(target), settings.batch_size)
        most = rounds.rounds * rounds.epochs * each
        told = f"{rounds.rounds} rounds of {rounds.epochs} epochs of at most {each} steps: {most}"
        lines.append(f"rounds    {rounds.rule}, {told}")
        steps += most * (2 if rounds.source_loss else 1)  # as many clouds of the source
    model = fresh_model(method, settings, classes)
    size = sum(value.numel() for value in model.parameters()) / 1e6
    lines.append(
        f"network   {settings.model}, {size:.2f} million parameters, {settings.num_points} points"
    )
    plain, usual = unstructure(settings), unstructure(TrainSettings())
    others = [f"{name} {plain[name]}" for name in plain if plain[name] != usual[name]]
    lines.append(f"settings  {', '.join(others) or 'defaults'}")
    seconds, count = _time_step(method, model, settings, classes)
    hours, minutes = divmod(round(steps * seconds / 60), 60)
    lines.append(
        f"time      about {hours} h {minutes:02} min with {count} threads here, at least: "
        f"{seconds:.2g} s a step"
    )
    return lines


def _time_step(
    method: str, model: PointClassifier, settings: TrainSettings, classes: int
) -> tuple[float, int]:
    """Return the seconds of a step, and with how many threads."""
    count = settings.threads if isinstance(settings.threads, int) else torch.get_num_threads()
    taken = []
    with threads(count):
        fabric = make_fabric(replace(settings, devices=1))
        step = trial_step(make_method(method, model, settings), classes, settings, fabric)
        for _ in range(_STEPS):
            start = time.perf_counter()
            step()
            taken.append(time.perf_counter() - start)
    return statistics.median(taken[1:]), count
