"""The counts that ``qs3 train --dry-run`` prints: clouds, steps, parameters."""

from collections import Counter

from qs3.adaptation import method_class
from qs3.io.clouds import PointClouds, UnlabelledClouds
from qs3.structure import unstructure
from qs3.training.batches import count_batches, epoch_steps
from qs3.training.config import SelfTrainingSettings, TrainSettings
from qs3.training.trainer import fresh_model, held_out


def describe_plan(
    method: str,
    source: PointClouds | None,
    target: UnlabelledClouds | None,
    settings: TrainSettings,
    rounds: SelfTrainingSettings | None,
    warm_up: bool = False,
) -> list[str]:
    """Return lines with the numbers of clouds, steps and parameters of a training.

    Steps of rounds are an upper bound: every cloud of the target selected. ``method`` is that
    before the rounds; with ``warm_up`` a given network takes the place of the training on the
    source, which is None if rounds learn from the target alone.
    """
    lines, classes, size = [], 10, settings.batch_size
    seen = 0 if target is None else len(target)
    if source is not None:
        held, classes = int(held_out(source, settings).sum()), len(source.class_names)
        counts = Counter(source.labels.tolist())
        named = ", ".join(f"{name} {counts[i]}" for i, name in enumerate(source.class_names))
        lines.append(f"source    {len(source)} clouds, {held} of them held out: {named}")
        if not warm_up:
            used = seen if method_class(method).uses_target else 0
            each = epoch_steps(len(source) - held, used, size)
            work = f"{settings.epochs} epochs of {each} steps of {size} clouds"
            lines.append(f"training  {method}, {work}: {settings.epochs * each}")
    if target is not None:
        lines.append(f"target    {seen} clouds")
    if rounds is not None:
        each = count_batches(seen, size)
        most = rounds.rounds * rounds.epochs * each
        work = f"{rounds.rounds} rounds of {rounds.epochs} epochs of at most {each} steps: {most}"
        lines.append(f"rounds    {rounds.rule}, {work}")
    count = sum(value.numel() for value in fresh_model(method, settings, classes).parameters())
    lines.append(
        f"network   {settings.model}, {count / 1e6:.2f} million parameters, "
        f"{settings.num_points} points"
    )
    plain, usual = unstructure(settings), unstructure(TrainSettings())
    others = [f"{name} {plain[name]}" for name in plain if plain[name] != usual[name]]
    lines.append(f"settings  {', '.join(others) or 'defaults'}")
    return lines
