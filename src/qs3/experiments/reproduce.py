"""Makes tables: data, runs, records, then the tables from the records alone."""

import os
from collections.abc import Sequence
from pathlib import Path
from unittest import mock

from qs3.errors import InputError, no_such
from qs3.experiments import GALLERIES
from qs3.experiments.domains import DATA, data_of
from qs3.experiments.experiment import load_experiment
from qs3.experiments.grid import Tell, data_sets, missing, require_same_data, run_grid
from qs3.experiments.runs import Run
from qs3.experiments.setup import Setup, claim
from qs3.experiments.table import Table
from qs3.store.executors import InlineExecutor, LocalExecutor


def choose_tables(
    names: Sequence[str], setup: Setup, rows: Sequence[str] = (), columns: Sequence[str] = ()
) -> list[Table]:
    """Return tables by name.

    Args:
        names: Names of tables.
        setup: Output folder, scale and data.
        rows: Lines of the tables; empty takes all.
        columns: Columns; empty takes the usual ones with data.
    """
    given = {"names": names, "methods": rows, "tasks": columns, "seeds": setup.seeds}
    for option, values in given.items():
        if len(set(values)) < len(values):
            raise InputError(f"--{option} {' '.join(map(str, values))}: name each once")
    if not setup.seeds:
        raise InputError("--seeds: name at least one")
    experiments = [load_experiment(name) for name in names]
    known = {
        "methods": {row.key for each in experiments for row in each.rows(setup.scale)},
        "tasks": {column.key for each in experiments for column in each.columns(setup.scale)},
    }
    for option, keys in known.items():
        for key in given[option]:
            if key not in keys:
                raise no_such(f"--{option} {key}", key, sorted(keys))
    return [Table(n, setup, tuple(rows), tuple(columns) or _at_hand(n, setup)) for n in names]


def _at_hand(name: str, setup: Setup) -> tuple[str, ...]:
    shown: list[str] = []
    for column in Table(name, setup).headings[1]:
        target = column.fields.get("target")
        if target is None or data_of(target, setup.own).train.at_hand(setup.shared):
            shown.append(column.key)
    return tuple(shown)


def collect_runs(tables: Sequence[Table]) -> list[Run]:
    """Return the runs of all tables, each once."""
    runs: dict[str, Run] = {}
    for table in tables:
        for run in table.runs():
            if runs.setdefault(run.name, run) != run:
                raise InputError(f"{table.name}: its run {run.name} is another one elsewhere")
    return list(runs.values())


def reproduce(
    tables: Sequence[Table],
    setup: Setup,
    tell: Tell,
    workers: int = 1,
    galleries: bool = False,
    dry_run: bool = False,
) -> list[Path]:
    """Make all missing data and runs, then the tables.

    Args:
        tables: Tables to make.
        setup: Output folder, scale and data.
        tell: Prints a line of progress.
        workers: Processes that scan and train.
        galleries: Draw the galleries too.
        dry_run: Print the numbers of missing scans and runs; write nothing.

    Returns:
        The main file of each table, and the folder of the galleries.
    """
    from qs3.experiments.data import choose_meshes, make_data, make_plans
    from qs3.experiments.galleries import draw_galleries, shown

    if workers < 1:
        raise InputError(f"--workers {workers}: must be at least 1")
    runs = collect_runs(tables)
    drawn = shown(setup) if galleries else []
    sides = choose_meshes(setup.scale, setup.shared)
    if not dry_run:
        claim(setup, sides.meshes)
    left = missing(runs, setup)  # a damaged record stops here, not after hours
    plans = make_plans(setup.scale, sides, [*data_sets(left), *drawn])
    names = ", ".join([*(table.name for table in tables), *[GALLERIES] * galleries])
    sets = [f"{plan.rows} scans of the {name}" for name, plan in plans.items()]
    tell(
        f"{names}, scale {setup.scale.name}: {', '.join(sets) or 'no scans'}; {len(runs)} runs, "
        f"{len(left)} of them missing"
    )
    if dry_run:
        return []
    if len(left) < len(runs):
        tell(f"{len(runs) - len(left)} of {len(runs)} runs are there already")
    for name, count in make_data(setup.out / DATA, plans, workers).items():
        if count:
            tell(f"{name}: {count} scans failed and are absent")
    failed: list[str] = []
    if left:
        require_same_data(runs, left, setup)
        executor = LocalExecutor(workers) if workers > 1 else InlineExecutor()
        # Progress bars of several processes would write over one another.
        with mock.patch.dict(os.environ, TQDM_DISABLE="1"):
            failed = run_grid(left, setup, tell, executor, workers)
    paths = []
    for table in tables:
        try:
            paths.append(table.write())
        except InputError as error:
            failed.append(str(error))
    if galleries:
        paths.append(draw_galleries(setup))
    if failed:
        raise InputError(f"{'; '.join(failed)}; mend that and run the same command again")
    return paths
