"""Makes tables anew: data, runs, records, then the tables from the records alone."""

import os
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

from qs3.errors import InputError
from qs3.experiments.bench_data import make_data, make_plans
from qs3.experiments.cost import Counts, run_seconds, step_seconds
from qs3.experiments.domains import REAL, REAL_CLOUDS, domain
from qs3.experiments.grid import (
    DATA,
    Evaluate,
    Tell,
    Train,
    data_sets,
    make_work,
    missing,
    run_grid,
)
from qs3.experiments.rows import ORDINARY
from qs3.experiments.runs import Run
from qs3.experiments.setup import Setup, claim
from qs3.store.executors import Executor, InlineExecutor, LocalExecutor
from qs3.store.manifest import MANIFEST
from qs3.store.plan import Plan, estimate


@runtime_checkable
class Part(Protocol):
    """A table or a figure."""

    @property
    def name(self) -> str:
        """Its name."""
        ...

    def runs(self) -> list[Run]:
        """Return the runs that it is made of."""
        ...

    def sets(self) -> list[str]:
        """Return data sets that it is drawn from, runs or none."""
        ...

    def write(self) -> Path:
        """Write it from the records, and return its main file."""
        ...


@dataclass(frozen=True)
class Cost:
    """What is left to do, in seconds on one core or device."""

    data: float
    """Scanning."""
    runs: dict[str, float]
    """Each run that is left, by its record."""

    @property
    def seconds(self) -> float:
        """All that is left."""
        return self.data + sum(self.runs.values())


def collect_runs(parts: Sequence[Part]) -> list[Run]:
    """Return the runs of all parts, each once.

    Raises:
        InputError: where two parts mean different runs by one name.
    """
    found: dict[str, Run] = {}
    for part in parts:
        for run in part.runs():
            if found.setdefault(run.record, run) != run:
                raise InputError(f"{part.name}: its run {run.record} is another one elsewhere")
    return list(found.values())


def plans_for(parts: Sequence[Part], runs: Sequence[Run], setup: Setup) -> dict[str, Plan]:
    """Return the work lists of all data sets that are to be made."""
    names = data_sets(runs, setup.own) + [name for part in parts for name in part.sets()]
    return make_plans(setup.scale, setup.shared, sets=names)


def reproduce(
    parts: Sequence[Part],
    setup: Setup,
    train: Train,
    evaluate: Evaluate,
    tell: Tell,
    dry_run: bool = False,
) -> list[Path]:
    """Make data, runs and tables, whatever of them is missing.

    Args:
        parts: What to make.
        setup: Where and how large.
        train: Trains a run; a function of a module where runs are made in other processes.
        evaluate: Scores it; likewise.
        tell: Is told how it goes.
        dry_run: Only tell what is to do and how long it takes; nothing is written.

    Returns:
        The main file of each part that was made.

    Raises:
        InputError: where the folder is for other settings, a record is damaged or not of its run,
            or a run failed; what was made stays made.
    """
    runs = collect_runs(parts)
    plans = plans_for(parts, runs, setup)
    if not dry_run:
        claim(setup, plans)
    left = missing(runs, setup.out, setup.own)  # a damaged record stops here, not after hours
    executor = _executor(setup)  # a missing extra is told before anything is made
    needed = set(data_sets(left, setup.own)) | {name for part in parts for name in part.sets()}
    plans = {name: plan for name, plan in plans.items() if name in needed}
    cost = measure(setup, left, plans)
    tell(describe(parts, setup, runs, plans, cost))
    if dry_run:
        return []
    if len(left) < len(runs):
        tell(f"{len(runs) - len(left)} of {len(runs)} runs are there already")
    absent = make_data(setup.out / DATA, plans, setup.workers)
    for name, count in absent.items():
        if count:
            tell(f"{name}: {count} scans failed and are absent")
    failed: list[str] = []
    if left:
        works = [make_work(run, setup.out, setup.shared, setup.own) for run in left]
        # A cluster gives a run its GPU itself.
        devices = () if setup.executor == "ray" else setup.devices
        at_once = max(len(setup.devices), setup.workers)
        with _quiet_workers():
            failed = run_grid(
                works, setup.out, train, evaluate, tell, cost.runs, executor, devices, at_once
            )
    paths = []
    for part in parts:
        try:
            paths.append(part.write())
        except InputError as error:
            failed.append(str(error))
    if failed:
        raise InputError(f"{'; '.join(failed)}; mend that and run the same command again")
    return paths


def _executor(setup: Setup) -> Executor:
    if setup.executor == "ray":
        from qs3.store.executors.ray_cluster import RayExecutor

        return RayExecutor(setup.address, gpus=1.0 if setup.devices else 0.0)
    if setup.devices:
        # A process sees the GPU that it was started with: each run has its own.
        return LocalExecutor(len(setup.devices), calls_per_process=1)
    return LocalExecutor(setup.workers) if setup.workers > 1 else InlineExecutor()


@contextmanager
def _quiet_workers() -> Iterator[None]:
    """Start processes without progress bars: several would write over one another."""
    before = os.environ.get("TQDM_DISABLE")
    os.environ["TQDM_DISABLE"] = "1"
    try:
        yield
    finally:
        if before is None:
            del os.environ["TQDM_DISABLE"]
        else:
            os.environ["TQDM_DISABLE"] = before


def measure(setup: Setup, left: Sequence[Run], plans: Mapping[str, Plan]) -> Cost:
    """Estimate what is left, from a few timed scans and a few timed steps of each kind."""
    steps = {
        network: step_seconds(
            [run for run in left if run.network == network],
            setup.scale.train_with(setup.threads, network=network),
        )
        for network in dict.fromkeys(run.network for run in left)
    }
    counts = {name: _counts(plan) for name, plan in plans.items()}
    expected, trained = {}, set()
    for run in left:
        learnt, target = domain(run.learns_from, setup.own), domain(run.target, setup.own)
        seen = Counts(
            source=_size(learnt.train, "train", counts),
            target=0 if run.row == ORDINARY else _size(target.train, "train", counts),
            test=_size(target.test, "test", counts),
        )
        # One training of the source alone serves several test sets.
        again = run.folder in trained
        trained.add(run.folder)
        expected[run.record] = run_seconds(run, seen, steps[run.network], only_scores=again)
    data = 0.0
    for name, plan in plans.items():
        if not (setup.out / DATA / name / MANIFEST).is_file():
            data += estimate(plan).seconds
    return Cost(data, expected)


def _counts(plan: Plan) -> dict[str, int]:
    train = sum(item.split == "train" for item in plan.items)
    return {"train": train, "test": plan.rows - train}


def _size(name: str, part: str, counts: Mapping[str, Mapping[str, int]]) -> int:
    """Clouds of a part of a data set; of the user's own the size is unknown: a thousand."""
    if name == REAL:
        return REAL_CLOUDS
    return counts[name][part] if name in counts else 1000


def describe(
    parts: Sequence[Part],
    setup: Setup,
    runs: Sequence[Run],
    plans: Mapping[str, Plan],
    cost: Cost,
) -> str:
    """Say what will be made and how long it takes."""
    counts = ", ".join(f"{plan.rows} scans of the {name}" for name, plan in plans.items())
    at_once = len(setup.devices) or setup.workers
    names = ", ".join(part.name for part in parts)
    return (
        f"{names}, scale {setup.scale.name}: {counts}; {len(runs)} runs, {len(cost.runs)} of them "
        f"missing; about {cost.seconds / at_once / 3600:.2f} hours here, "
        f"{cost.data / at_once / 3600:.2f} of them for scans ({at_once} at a time)"
    )
