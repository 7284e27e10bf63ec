"""What a step of each method costs, and a grid of runs from it."""

import statistics
import time
from collections.abc import Iterable, Mapping
from dataclasses import replace

import torch

from qs3.adaptation import Batch, create_method, method_class
from qs3.adaptation.names import split_method
from qs3.experiments.runs import Run
from qs3.training.batches import count_batches
from qs3.training.config import TrainSettings
from qs3.training.job import new_model_for

_CLASSES = 10
_PASS = 1 / 3
"""Of the time of a step, a pass without gradient takes about so much."""


class Step:
    """One optimiser step of a method on random clouds, to be timed.

    Args:
        method: Name of a method without rounds.
        settings: Network, points and batch size.
        device: Where to compute.
    """

    def __init__(self, method: str, settings: TrainSettings, device: torch.device) -> None:
        with torch.random.fork_rng(devices=[]):
            torch.manual_seed(0)
            model = new_model_for(method, settings, _CLASSES, 0)
            self.method = create_method(method, model).to(device).train()
        self.generator = torch.Generator().manual_seed(0)
        size = (settings.batch_size, settings.num_points, 3)
        points = torch.rand(2, *size, generator=self.generator).sub_(0.5).to(device)
        labels = torch.arange(settings.batch_size, device=device) % _CLASSES
        self.source = Batch(points[0], labels)
        self.target = points[1] if self.method.uses_target else None
        self.optimiser = torch.optim.Adam(self.method.parameter_groups(1e-3))
        self.device = device

    def __call__(self) -> float:
        """Take the step and return its seconds."""
        self._wait()
        start = time.perf_counter()
        losses = self.method(self.source, self.target, 0.5, self.generator)
        self.optimiser.zero_grad()
        torch.stack(list(losses.values())).sum().backward()
        self.optimiser.step()
        self.method.after_step()
        self._wait()
        return time.perf_counter() - start

    def _wait(self) -> None:
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)


def step_seconds(runs: Iterable[Run], settings: TrainSettings, steps: int = 2) -> dict[str, float]:
    """Return the median seconds of a step of each method of some runs of one network.

    The first step, on few points, warms up and is not counted.
    """
    cuda = settings.accelerator != "cpu" and torch.cuda.is_available()
    device = torch.device("cuda" if cuda else "cpu")
    names = ["source-only", *(split_method(run.kind.method)[0] for run in runs)]
    threads = torch.get_num_threads()
    if isinstance(settings.threads, int):
        torch.set_num_threads(settings.threads)
    try:
        seconds = {}
        for name in dict.fromkeys(names):
            Step(name, replace(settings, num_points=64, batch_size=4), device)()
            step = Step(name, settings, device)
            seconds[name] = statistics.median(step() for _ in range(steps))
        return seconds
    finally:
        torch.set_num_threads(threads)


def run_seconds(
    run: Run,
    clouds: tuple[int, int, int],
    steps: Mapping[str, float],
    only_scores: bool = False,
) -> float:
    """Estimate the seconds of a run; a round is taken to keep every cloud of the target.

    Args:
        run: The run.
        clouds: Numbers of clouds to learn from, to adapt to, to score on.
        steps: Seconds of a step by method.
        only_scores: Whether its network is there, and nothing but its scores is missing.
    """
    settings, rounds, (source, target, test) = run.train, run.self_training, clouds
    base, size, plain = split_method(run.kind.method)[0], settings.batch_size, steps["source-only"]
    if only_scores:
        return test / size * _PASS * plain
    looks, seconds = 1, 0.0
    if not run.kind.warm_up:
        batches = count_batches(source - int(settings.holdout * source), size)
        if method_class(base).uses_target:
            batches = max(batches, count_batches(target, size))
        seconds += settings.epochs * batches * steps[base]
        if settings.validate_every:
            looks = -(-settings.epochs // settings.validate_every)
    if rounds is not None:
        batches = rounds.steps_per_epoch or count_batches(target, size)
        domains = 2 if rounds.source_loss else 1
        seconds += rounds.rounds * rounds.epochs * batches * domains * plain
        looks = 2 * rounds.rounds
    return seconds + looks * sum(clouds) / size * _PASS * plain
