"""Makes tables: data, records, then the tables from the records alone."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path

from qs3.errors import InputError, no_such
from qs3.files import write_bytes, write_text
from qs3.paper import GALLERIES
from qs3.paper.cells import Cell, data_sets_of
from qs3.paper.domains import DATA, REAL_CLOUDS, folder_of_data
from qs3.paper.experiment import load_experiment
from qs3.paper.grid import Report, find_missing, require_same_data, run_grid
from qs3.paper.setup import Setup, claim
from qs3.paper.table import Table
from qs3.store.executors import InlineExecutor, LocalExecutor


def choose_tables(
    names: Sequence[str], setup: Setup, rows: Sequence[str] = (), columns: Sequence[str] = ()
) -> list[Table]:
    """Return tables by name; by default with all rows, and the usual columns that have data."""
    experiments = [load_experiment(name, setup.scale) for name in names]
    known = {
        "methods": {row.key for each in experiments for row in each.rows},
        "tasks": {column.key for each in experiments for column in each.columns},
    }
    for option, keys in (("methods", rows), ("tasks", columns)):
        for key in keys:
            if key not in known[option]:
                raise no_such(f"--{option} {key}", key, sorted(known[option]))
    chosen = dict.fromkeys(names)
    return [Table(n, setup, tuple(rows), tuple(columns) or _at_hand(n, setup)) for n in chosen]


def _at_hand(name: str, setup: Setup) -> tuple[str, ...]:
    files = {"R": REAL_CLOUDS[0], "U": REAL_CLOUDS[1]}
    here = [
        kind for kind, file in files.items() if setup.shared and (setup.shared / file).is_file()
    ]
    absent = files.keys() - here - setup.data.keys()
    columns = Table(name, setup).headings[1]
    return tuple(column.key for column in columns if column.fields.get("target") not in absent)


def collect_cells(tables: Iterable[Table]) -> list[Cell]:
    """Return the cells of all tables, each once, with those that others start from."""
    cells: dict[Cell, None] = {}
    for table in tables:
        for cell in table.all_cells:
            for part in filter(None, cell.parts(table.setup)):
                part.locate(table.setup.out, table.setup.shared)
            cells |= dict.fromkeys(filter(None, (cell.warm_up, cell)))
    return list(cells)


def write_table(table: Table) -> Path:
    """Write a table in all formats, and its figure if it has one, from the records alone."""
    from qs3.paper.figures import picture
    from qs3.paper.table_text import FORMATS

    path = table.setup.out / f"{table.name}.md"
    for kind, make in FORMATS.items():
        write_text(path.with_suffix(f".{kind}"), make(table))
    if table.experiment.columns[0].axis:
        write_bytes(path.with_suffix(".png"), picture(table, "png"))
    if table.faults:
        raise InputError("; ".join(table.faults))
    return path


def reproduce(
    tables: Sequence[Table],
    setup: Setup,
    report: Report,
    workers: int = 1,
    galleries: bool = False,
    dry_run: bool = False,
) -> list[Path]:
    """Make all missing data and runs, then the tables and their galleries.

    A dry run prints the numbers of missing scans and runs, and writes nothing.

    Returns:
        The main file of each table, and the folder of the galleries.
    """
    from qs3.paper.galleries import draw_galleries, shown
    from qs3.paper.prepare import choose_meshes, describe_meshes, make_data, make_plans

    if workers < 1:
        raise InputError(f"--workers {workers}: must be at least 1")
    cells = collect_cells(tables)
    drawn = shown(setup) if galleries else []
    sides = choose_meshes(setup.scale, setup.shared)
    setup = replace(setup, meshes=describe_meshes(sides))
    setup = claim(setup, make=not dry_run)
    left = find_missing(cells, setup)  # a damaged record stops here, not after hours
    needed = data_sets_of(left, setup)
    plans = make_plans(setup.scale, sides, [*needed, *drawn])
    names = ", ".join([*(table.name for table in tables), *[GALLERIES] * galleries])
    sets = [f"{plan.rows} scans of the {folder_of_data(data)}" for data, plan in plans.items()]
    report(
        f"{names}, scale {setup.scale.name}: {', '.join(sets) or 'no scans'}; {len(cells)} runs, "
        f"{len(left)} of them missing"
    )
    if dry_run:
        return []
    for data, count in make_data(setup.out / DATA, plans, workers).items():
        if count:
            report(f"{data}: {count} scans failed and are absent")
    failed: list[str] = []
    if left:
        from qs3.training.progress import without_bars  # it imports torch

        require_same_data(cells, needed, setup)
        executor = LocalExecutor(workers) if workers > 1 else InlineExecutor()
        with without_bars():
            failed = run_grid(left, setup, report, executor)
    paths = []
    for table in tables:
        try:
            paths.append(write_table(replace(table, setup=setup)))
        except InputError as error:
            failed.append(str(error))
    if galleries:
        paths.append(draw_galleries(setup))
    if failed:
        raise InputError(f"{'; '.join(failed)}; mend that and run the same command again")
    return paths
