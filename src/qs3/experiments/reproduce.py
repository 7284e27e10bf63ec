"""Makes tables anew: data, runs, records, then the tables from the records alone."""

import os
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Literal, Union
from unittest import mock

from qs3.errors import InputError, no_such
from qs3.experiments import GALLERIES
from qs3.experiments.domains import DATA, data_of
from qs3.experiments.experiment import load_experiment
from qs3.experiments.grid import Tell, data_sets, missing, require_same_data, run_grid
from qs3.experiments.runs import Run
from qs3.experiments.setup import Setup, claim
from qs3.experiments.table import Table
from qs3.store.executors import Executor, InlineExecutor, LocalExecutor

if TYPE_CHECKING:
    from qs3.experiments.galleries import Galleries


@dataclass(frozen=True)
class Workers:
    """Who does the work."""

    workers: int = 2
    """Processes that scan, and that train where no device is named."""
    devices: tuple[str, ...] = ()
    """GPUs by index; each makes one run at a time, in a process of its own."""
    executor: Literal["local", "ray"] = "local"
    """Where runs are made: here, or on a Ray cluster whose machines all see --out."""
    address: str = "auto"
    """Of the Ray cluster's head; auto is the one that this machine belongs to, local starts one."""

    def __post_init__(self) -> None:
        if self.workers < 1:
            raise InputError(f"--workers {self.workers}: must be at least 1")
        for device in self.devices:
            if not device.isdecimal():
                raise InputError(f"--devices {device}: name GPUs by index, such as 0 1")

    def start(self) -> Executor:
        """Return what makes the runs.

        Raises:
            MissingExtraError: where Ray is asked for and absent.
        """
        if self.executor == "ray":
            from qs3.store.executors.ray_cluster import RayExecutor

            return RayExecutor(self.address, gpus=1.0 if self.devices else 0.0)
        if self.devices:
            # A process sees the GPU that it was started with: each run has its own.
            return LocalExecutor(len(self.devices), calls_per_process=1)
        return LocalExecutor(self.workers) if self.workers > 1 else InlineExecutor()


Product = Union[Table, "Galleries"]
"""What can be made: its runs and data sets, and its files from the records."""


def products(
    names: Sequence[str], setup: Setup, rows: Sequence[str] = (), columns: Sequence[str] = ()
) -> list[Product]:
    """Return what is to be made.

    Args:
        names: Tables and ``galleries``.
        setup: Where and how large.
        rows: Lines of the tables; empty takes all.
        columns: Columns; empty takes the usual ones whose data are at hand.

    Raises:
        InputError: where something is named twice, or a line or column is in none of the tables.
    """
    given = {"names": names, "methods": rows, "tasks": columns, "seeds": setup.seeds}
    for option, values in given.items():
        if len(set(values)) < len(values):
            raise InputError(f"--{option} {' '.join(map(str, values))}: name each once")
    if not setup.seeds:
        raise InputError("--seeds: name at least one")
    made: list[Product] = []
    choices: dict[str, set[str]] = {"methods": set(), "tasks": set()}
    for name in names:
        if name == GALLERIES:
            from qs3.experiments.galleries import Galleries

            made.append(Galleries(setup))
            continue
        experiment = load_experiment(name)
        choices["methods"] |= {row.key for row in experiment.rows(setup.scale)}
        choices["tasks"] |= {column.key for column in experiment.columns(setup.scale)}
        made.append(Table(name, setup, tuple(rows), tuple(columns) or _at_hand(name, setup)))
    for option, keys in choices.items():
        for key in given[option]:
            if key not in keys:
                raise no_such(f"--{option} {key}", key, sorted(keys))
    return made


def _at_hand(name: str, setup: Setup) -> tuple[str, ...]:
    """Return the usual columns, those on real objects only where they are at hand."""
    shown: list[str] = []
    for column in Table(name, setup).headings()[1]:
        target = column.fields.get("target")
        if target is None or data_of(target, setup.own).train.at_hand(setup.shared):
            shown.append(column.key)
    return tuple(shown)


def collect_runs(products: Sequence[Product]) -> list[Run]:
    """Return the runs of all products, each once.

    Raises:
        InputError: where two products mean different runs by one name.
    """
    runs: dict[str, Run] = {}
    for product in products:
        for run in product.runs():
            if runs.setdefault(run.name, run) != run:
                raise InputError(f"{product.name}: its run {run.name} is another one elsewhere")
    return list(runs.values())


def reproduce(
    products: Sequence[Product], setup: Setup, workers: Workers, tell: Tell, dry_run: bool = False
) -> list[Path]:
    """Make data, runs and tables, whatever of them is missing.

    Args:
        products: What to make.
        setup: Where and how large.
        workers: Who makes it.
        tell: Is told how it goes.
        dry_run: Only tell how many scans and runs are missing; nothing is written.

    Returns:
        The main file of each product that was made.

    Raises:
        InputError: where the folder is for other settings, a record is damaged or not of its run,
            or a run failed; what was made stays made.
    """
    from qs3.experiments.data import choose_meshes, make_data, make_plans

    runs = collect_runs(products)
    drawn = [data for product in products for data in product.sets()]
    sides = choose_meshes(setup.scale, setup.shared)
    plans = make_plans(setup.scale, sides, [*data_sets(runs, setup.own), *drawn])
    if not dry_run:
        claim(setup, sides.meshes)
    left = missing(runs, setup)  # a damaged record stops here, not after hours
    executor = workers.start()  # a missing extra is told before anything is made
    needed = {data.name for data in [*data_sets(left, setup.own), *drawn]}
    plans = {name: plan for name, plan in plans.items() if name in needed}
    names = ", ".join(product.name for product in products)
    sets = [f"{plan.rows} scans of the {name}" for name, plan in plans.items()]
    scans = ", ".join(sets) or "no scans"
    tell(
        f"{names}, scale {setup.scale.name}: {scans}; {len(runs)} runs, {len(left)} of them missing"
    )
    if dry_run:
        return []
    if len(left) < len(runs):
        tell(f"{len(runs) - len(left)} of {len(runs)} runs are there already")
    for name, count in make_data(setup.out / DATA, plans, workers.workers).items():
        if count:
            tell(f"{name}: {count} scans failed and are absent")
    failed: list[str] = []
    if left:
        require_same_data(runs, left, setup)
        # A cluster gives a run its GPU itself.
        devices = () if workers.executor == "ray" else workers.devices
        at_once = max(len(workers.devices), workers.workers)
        # Processes start without progress bars: several would write over one another.
        with mock.patch.dict(os.environ, TQDM_DISABLE="1"):
            failed = run_grid(left, setup, tell, executor, devices, at_once)
    paths = []
    for product in products:
        try:
            paths.append(product.write())
        except InputError as error:
            failed.append(str(error))
    if failed:
        raise InputError(f"{'; '.join(failed)}; mend that and run the same command again")
    return paths
