"""The paper's tables and figures: all of them by name, read from records, written to files."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from qs3.errors import InputError
from qs3.evaluation.records import RunRecord
from qs3.experiments import (
    ordinary,
    partiality,
    pointda10,
    real2sim,
    sensors,
    thresholds,
    uda,
    views,
)
from qs3.experiments.catalogue import FigureFormat, TableFormat
from qs3.experiments.domains import Domain, domain
from qs3.experiments.experiment import Experiment, Grid, cell_runs, fill
from qs3.experiments.figures import draw
from qs3.experiments.grid import RESULTS, make_work, read_result
from qs3.experiments.render import to_csv, to_latex, to_markdown
from qs3.experiments.runs import Run, with_warm_up
from qs3.experiments.scales import Scale
from qs3.experiments.setup import Setup
from qs3.files import write_bytes, write_text
from qs3.report.figure import png_bytes, svg_bytes

EXPERIMENTS: Mapping[str, Experiment] = {
    one.EXPERIMENT.name: one.EXPERIMENT
    for one in (ordinary, uda, real2sim, views, thresholds, partiality, sensors, pointda10)
}
"""Every table and figure that comes from records, by name."""


@dataclass(frozen=True)
class PaperTable:
    """A table with its figure; one of the parts of `qs3.experiments.reproduction`."""

    experiment: Experiment
    """Which one."""
    setup: Setup
    """Where and how large."""
    rows: tuple[str, ...] = ()
    """Lines; empty takes all."""
    columns: tuple[str, ...] = ()
    """Columns; empty takes all."""

    @property
    def name(self) -> str:
        """Name of the table and of its files."""
        return self.experiment.name

    def cells(self) -> dict[tuple[str, str], list[Run]]:
        """Return the runs of each cell.

        Raises:
            InputError: where no cell is left, or the data of one is not at hand.
        """
        setup = self.setup
        cells = cell_runs(
            self.experiment, setup.scale, setup.seeds, setup.threads, self.rows, self.columns
        )
        mixed = sorted(set(self.experiment.made) & set(setup.own))
        if mixed:
            raise InputError(
                f"{self.name}: compares {', '.join(mixed)} with what is made here of the same "
                "meshes; leave out that --data"
            )
        if not any(cells.values()):
            lines, columns = (
                ", ".join(key for key, _ in named)
                for named in (
                    self.experiment.rows(setup.scale),
                    self.experiment.columns(setup.scale),
                )
            )
            raise InputError(f"{self.name}: its lines are {lines}; its columns are {columns}")
        return cells

    def runs(self) -> list[Run]:
        """Return the runs of all cells, a warm-up before what starts from it."""
        found: dict[str, Run] = {}
        cells = self.cells()
        for seed in self.setup.seeds:  # a seed is finished before the next begins
            for runs in cells.values():
                for run in (one for one in runs if one.seed == seed):
                    make_work(run, self.setup.out, self.setup.shared, self.setup.own)
                    for one in with_warm_up(self.setup.scale, run):
                        found.setdefault(one.record, one)
        return list(found.values())

    def sets(self) -> list[str]:
        """Return no further data sets."""
        return []

    def write(self) -> Path:
        """Write the table in all formats and the figure, from the records alone.

        Raises:
            InputError: where a record is refused; the file is named, and the rest is written.
        """
        grid, faults = self.grid()
        path = self.setup.out / f"{self.name}.md"
        for kind in ("md", "csv", "tex"):
            write_text(path.with_suffix(f".{kind}"), self.text(grid, kind))
        write_bytes(path.with_suffix(".png"), self.picture(grid, "png"))
        if faults:
            raise InputError("; ".join(faults))
        return path

    def grid(self) -> tuple[Grid, list[str]]:
        """Fill the table from the records that are there.

        Returns:
            The table, and what is wrong with each record that was refused.
        """
        cells = self.cells()
        records: dict[str, RunRecord] = {}
        faults = []
        for run in (run for runs in cells.values() for run in runs):
            path = self.setup.out / RESULTS / run.record
            if path.is_file() and run.record not in records:
                try:
                    records[run.record] = read_result(path, run, self.setup.own)
                except InputError as error:
                    faults.append(str(error))
        faults += _mixed(records, cells)
        return fill(self.experiment, self.setup.scale, cells, records), list(dict.fromkeys(faults))

    def text(self, grid: Grid, kind: TableFormat) -> str:
        """Return the table as Markdown, CSV or LaTeX."""
        if kind == "csv":
            return to_csv(grid)
        if kind == "tex":
            return to_latex(grid)
        return to_markdown(grid, self._intro(), self.command())

    def picture(self, grid: Grid, kind: FigureFormat) -> bytes:
        """Return the figure as PNG or SVG."""
        figure = draw(grid)
        return png_bytes(figure) if kind == "png" else svg_bytes(figure)

    def command(self) -> str:
        """Return the command that makes what is missing."""
        setup = self.setup
        words = [f"qs3 reproduce {self.name} --out {setup.out.name} --scale {setup.scale.name}"]
        words.append(f"--seeds {' '.join(map(str, setup.seeds))}")
        words += [f"--threads {setup.threads}"] if setup.threads not in (None, 1) else []
        for name, one in setup.own.items():
            words.append(f"--data {name}={Path(one.train).name}:{one.train_split or ''}:")
            words[-1] += one.test_split or ""
        return " ".join(words)

    def _intro(self) -> list[str]:
        scale = self.setup.scale
        runs = [run for runs in self.cells().values() for run in runs]
        train = runs[0].train  # the same for all but for network and seed
        names = dict.fromkeys([run.source for run in runs] + [run.target for run in runs])
        domains = [domain(name, self.setup.own) for name in names]
        text = [
            f"Scale {scale.name}{_objects(scale, domains)}: {train.num_points} points, "
            f"{train.epochs} epochs, batches of {train.batch_size}, schedule {train.schedule}; "
            f"seeds {', '.join(map(str, self.setup.seeds))}. Per cent, mean ± standard error "
            "(ddof = 1) over n seeds, from the records alone; the network is the last epoch's.",
        ]
        text.append("; ".join(one.title for one in domains) + ".")
        stand_ins = [
            f"{one.title.partition(':')[0]} for {one.stands_for}"
            for one in domains
            if one.stands_for
        ]
        if stand_ins:
            text.append(
                f"**Stand-ins, made here**: {', '.join(stand_ins)}. A simulator on both sides "
                "flatters, and the paper's figures are of its own data: a yardstick, no target."
            )
        told = scale.rounds_told()
        if told and any(run.self_training is not None for run in runs):
            text.append(told)
        if scale.smoke:
            text.append(
                "Below 40 training objects a class, 512 points or the whole networks: shows that "
                "everything runs, ranks nothing."
            )
        return text


def _objects(scale: Scale, domains: Sequence[Domain]) -> str:
    if any(one.train == "source" for one in domains if not one.own):
        return f", {scale.source_per_class} objects a class of M and S"
    return ""


def _mixed(
    records: dict[str, RunRecord], cells: Mapping[tuple[str, str], Sequence[Run]]
) -> list[str]:
    """Take out records that read other data than the first of their domain, and name them."""
    sums: dict[str, tuple[str, str]] = {}
    faults = []
    for run in (run for runs in cells.values() for run in runs):
        record = records.get(run.record)
        if record is None:
            continue
        known = {f"train {run.learns_from}": record.source, f"test {run.target}": record.test}
        if record.target is not None:
            known[f"train {run.target}"] = record.target
        for name, data in known.items():
            first, where = sums.setdefault(name, (data.checksum, run.record))
            if first != data.checksum:
                faults.append(f"{run.record}: read other data ({name}) than {where}; delete it")
                records.pop(run.record, None)
    return faults
