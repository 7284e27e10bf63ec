"""What a training would do and about how long it takes, before it is begun."""

import os
import time
from collections import Counter
from dataclasses import dataclass, replace
from unittest import mock

import numpy as np
import torch

from qs3.adaptation import method_class
from qs3.io.clouds import PointClouds, UnlabelledClouds
from qs3.structure import unstructure
from qs3.training.batches import count_batches
from qs3.training.config import SelfTrainingSettings, TrainSettings
from qs3.training.distributed import make_fabric
from qs3.training.job import fresh_model, make_method
from qs3.training.loop import train
from qs3.training.predict import describe
from qs3.training.prepared import prepare_clouds
from qs3.training.threads import threads
from qs3.training.validation import held_out

_STEPS = 3
"""Steps of each of two epochs; the first, which warms up, does not count."""


@dataclass(frozen=True)
class Cost:
    """Seconds that parts of a training take here: of the processor, or by the clock on a GPU."""

    step: float
    """An optimiser step, its batch made and augmented."""
    look: float
    """The answer to a cloud."""
    preparation: float
    """The preparation of a cloud."""


def measure(
    method: str, source: PointClouds, target: UnlabelledClouds, settings: TrainSettings
) -> Cost:
    """Train for a few steps on the first clouds of each domain, and tell what that took.

    Processor seconds, since those of the clock tell how busy a machine is now; threads divide them.
    """
    count = settings.threads if isinstance(settings.threads, int) else torch.get_num_threads()
    settings = replace(settings, epochs=2, devices=1)
    few = slice(settings.batch_size)
    source = source.select(np.arange(len(source))[few])
    target = UnlabelledClouds(target.points[few], target.ids[few])
    fabric = make_fabric(settings)
    cuda = fabric.device.type == "cuda"
    clock, share = (time.perf_counter, 1) if cuda else (time.process_time, 1 / count)
    with threads(count), mock.patch.dict(os.environ, TQDM_DISABLE="1"):
        how = settings.num_points, settings.preparation
        prepare_clouds(source.select(np.arange(len(source))[:2]), *how)  # compiles
        began = clock()
        prepared = prepare_clouds(source, *how), prepare_clouds(target, *how)
        preparation = (clock() - began) / (len(source) + len(target))
        model = fresh_model(method, settings, len(source.class_names))
        trained = make_method(method, model, settings)
        last = train(trained, *prepared, settings, fabric=fabric, steps_per_epoch=_STEPS)[0][-1]
        began = clock()
        describe(trained.model, prepared[0], fabric=fabric)
        look = (clock() - began) / len(source)
    step = (last.seconds if cuda else last.cpu_seconds) / last.steps
    return Cost(step * share, look * share, preparation * share)


def epoch_steps(method: str, settings: TrainSettings, learnt: int, target: int) -> int:
    """Count the steps of an epoch: one pass over the larger of the domains that it trains on."""
    size, least = settings.batch_size, 2 * settings.devices
    steps = count_batches(learnt, size, least)
    if target and method_class(method).uses_target:
        steps = max(steps, count_batches(max(target, least), size, least))
    return steps


def round_steps(
    rounds: SelfTrainingSettings, settings: TrainSettings, target: int, kept: float = 1.0
) -> int:
    """Count the steps of all rounds that keep a share of the clouds they choose from."""
    pool, steps = target, 0
    for _ in range(rounds.rounds):
        chosen = int(pool * kept)
        each = count_batches(chosen, settings.batch_size, 2 * settings.devices)
        steps += rounds.epochs * each
        pool = chosen if rounds.pool == "shrinking" else target
    return steps


def describe_plan(
    method: str,
    source: PointClouds | None,
    target: UnlabelledClouds | None,
    settings: TrainSettings,
    rounds: SelfTrainingSettings | None,
    warm_up: bool = False,
) -> list[str]:
    """Return lines that say what would be trained, on how much, in how many steps and how long.

    The time is that of steps, taken here on the first clouds, and of the preparation; that of
    rounds is the most: every cloud of the target selected.

    Args:
        method: Method before the rounds, if there are any.
        source: Labelled clouds; None where rounds learn from the target alone.
        target: Clouds without labels.
        settings: How to train.
        rounds: How to train oneself; None without rounds.
        warm_up: Whether a network is given that takes the place of the training on the source.
    """
    lines, steps, classes = [], 0, 10
    seen = 0 if target is None else len(target)
    if source is not None:
        held, classes = int(held_out(source, settings).sum()), len(source.class_names)
        counts = Counter(source.labels.tolist())
        named = ", ".join(f"{name} {counts[i]}" for i, name in enumerate(source.class_names))
        lines.append(f"source    {len(source)} clouds, {held} of them held out: {named}")
        if not warm_up:
            each = epoch_steps(method, settings, len(source) - held, seen)
            steps = settings.epochs * each
            work = f"{settings.epochs} epochs of {each} steps of {settings.batch_size} clouds"
            lines.append(f"training  {method}, {work}: {steps}")
    if target is not None:
        lines.append(f"target    {len(target)} clouds")
    if rounds is not None and target is not None:
        most = round_steps(rounds, settings, seen)
        each = most // (rounds.rounds * rounds.epochs)
        work = f"{rounds.rounds} rounds of {rounds.epochs} epochs of at most {each} steps: {most}"
        lines.append(f"rounds    {rounds.rule}, {work}")
        steps += most * (2 if rounds.source_loss else 1)  # as many clouds of the source
    model = fresh_model(method, settings, classes)
    count = sum(value.numel() for value in model.parameters()) / 1e6
    lines.append(
        f"network   {settings.model}, {count:.2f} million parameters, {settings.num_points} points"
    )
    plain, usual = unstructure(settings), unstructure(TrainSettings())
    others = [f"{name} {plain[name]}" for name in plain if plain[name] != usual[name]]
    lines.append(f"settings  {', '.join(others) or 'defaults'}")
    if source is None:
        assert target is not None  # noqa: S101
        names = tuple(map(str, range(classes)))
        labels = np.arange(len(target)) % classes
        source = PointClouds(target.points, labels, names, target.ids)
    cost = measure(method, source, source.without_labels() if target is None else target, settings)
    seconds = steps * cost.step + (len(source) + seen) * cost.preparation
    hours, minutes = divmod(round(seconds / 60), 60)
    lines.append(
        f"time      about {hours} h {minutes:02} min of processor time here: "
        f"{cost.step:.2g} s a step"
    )
    return lines
