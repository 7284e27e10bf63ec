"""Makes tables: data, runs, records, then the tables from the records alone."""

import os
from collections.abc import Sequence
from pathlib import Path
from unittest import mock

from qs3.errors import InputError, no_such
from qs3.experiments import GALLERIES
from qs3.experiments.domains import DATA, Domain, data_of
from qs3.experiments.experiment import load_experiment
from qs3.experiments.grid import Tell, data_sets, missing, require_same_data, run_grid
from qs3.experiments.runs import Run
from qs3.experiments.setup import Setup, claim
from qs3.experiments.table import Table
from qs3.files import write_bytes, write_text
from qs3.store.executors import InlineExecutor, LocalExecutor


def choose_tables(
    names: Sequence[str], setup: Setup, rows: Sequence[str] = (), columns: Sequence[str] = ()
) -> list[Table]:
    """Return tables by name; by default with all rows, and the usual columns that have data."""
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
    def has_data(target: Domain | None) -> bool:
        return target is None or data_of(target, setup.own).train.at_hand(setup.shared)

    columns = Table(name, setup).headings[1]
    return tuple(column.key for column in columns if has_data(column.fields.get("target")))


def collect_runs(tables: Sequence[Table]) -> list[Run]:
    """Return the runs of all tables, each once."""
    runs: dict[str, Run] = {}
    for table in tables:
        for run in table.runs():
            if runs.setdefault(run.name, run) != run:
                raise InputError(f"{table.name}: its run {run.name} is another one elsewhere")
    return list(runs.values())


def write_table(table: Table) -> Path:
    """Write a table in all formats and its figure, from the records alone."""
    from qs3.experiments.figures import picture
    from qs3.experiments.text import FORMATS

    path = table.setup.out / f"{table.name}.md"
    for kind, make in FORMATS.items():
        write_text(path.with_suffix(f".{kind}"), make(table))
    write_bytes(path.with_suffix(".png"), picture(table, "png"))
    if table.faults:
        raise InputError("; ".join(table.faults))
    return path


def reproduce(
    tables: Sequence[Table],
    setup: Setup,
    tell: Tell,
    workers: int = 1,
    galleries: bool = False,
    dry_run: bool = False,
) -> list[Path]:
    """Make all missing data and runs, then the tables and their galleries.

    A dry run prints the numbers of missing scans and runs, and writes nothing.

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
            paths.append(write_table(table))
        except InputError as error:
            failed.append(str(error))
    if galleries:
        paths.append(draw_galleries(setup))
    if failed:
        raise InputError(f"{'; '.join(failed)}; mend that and run the same command again")
    return paths
