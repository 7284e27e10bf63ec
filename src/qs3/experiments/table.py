"""A table of a folder: its runs, and what their records say."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import pandas as pd

from qs3.errors import InputError
from qs3.evaluation.compare import SeedComparison, compare_seeds
from qs3.evaluation.records import RunRecord
from qs3.evaluation.tables import average, frame
from qs3.experiments.experiment import Experiment, Headings, Place, load_experiment
from qs3.experiments.grid import find_result, read_results
from qs3.experiments.runs import Run
from qs3.experiments.setup import Setup
from qs3.files import write_bytes, write_text


@dataclass(frozen=True)
class Table:
    """A table with its figure; one of the parts of `qs3.experiments.reproduce`."""

    name: str
    """Which one; also the name of its files."""
    setup: Setup
    """Where and how large."""
    rows: tuple[str, ...] = ()
    """Keys of lines; empty takes all."""
    columns: tuple[str, ...] = ()
    """Keys of columns; empty takes the experiment's usual ones."""

    @property
    def experiment(self) -> Experiment:
        """What it is a table of."""
        return load_experiment(self.name)

    def headings(self) -> tuple[Headings, Headings]:
        """Return rows and columns.

        Raises:
            InputError: where none is left, or data of the user do not fit the experiment.
        """
        experiment, setup = self.experiment, self.setup
        rows, columns = experiment.rows(setup.scale), experiment.columns(setup.scale)
        kept = tuple(row for row in rows if not self.rows or row.key in self.rows)
        wanted = self.columns or experiment.usual(setup.scale)
        shown = tuple(column for column in columns if not wanted or column.key in wanted)
        mixed = sorted(set(experiment.made) & set(setup.own))
        if mixed:
            raise InputError(
                f"{self.name}: compares {', '.join(mixed)} with what is made here of the same "
                "meshes; leave out that --data"
            )
        if not kept or not shown:
            names = [", ".join(heading.key for heading in part) for part in (rows, columns)]
            raise InputError(f"{self.name}: its lines are {names[0]}; its columns are {names[1]}")
        return kept, shown

    def cells(self) -> dict[Place, list[Run]]:
        """Return the runs of each cell, in the order of the seeds."""
        rows, columns = self.headings()
        cells: dict[Place, list[Run]] = {}
        for row in rows:
            for column in columns:
                runs = [
                    self.experiment.run(self.setup, row, column, seed) for seed in self.setup.seeds
                ]
                cells[row.key, column.key] = [run for run in runs if run is not None]
        return cells

    def runs(self) -> list[Run]:
        """Return the runs of all cells, a warm-up before what starts from it.

        Raises:
            InputError: where the data of one are not at hand.
        """
        wanted: dict[str, Run] = {}
        cells = self.cells()
        for seed in self.setup.seeds:  # a seed is finished before the next begins
            for run in (run for runs in cells.values() for run in runs if run.seed == seed):
                for part in run.parts:
                    if part is not None:
                        part.locate(self.setup.out, self.setup.shared)
                for needed in (run.warm_up, run):
                    if needed is not None:
                        wanted.setdefault(needed.name, needed)
        return list(wanted.values())

    def read(self) -> "FilledTable":
        """Fill the table from its records; ``faults`` names each record that is refused."""
        cells = self.cells()
        records: dict[str, RunRecord] = {}
        results, faults = read_results(self.setup)
        runs = {run.name: run for runs in cells.values() for run in runs}
        for name, run in runs.items():
            try:
                record = find_result(run, self.setup, results)
            except InputError as error:
                faults.append(str(error))
                continue
            if record is not None:
                records[name] = record
        faults += _take_out_mixed(records, runs)
        return FilledTable(self, cells, records, tuple(faults))

    def write(self) -> Path:
        """Write the table in all formats and the figure, from the records alone.

        Raises:
            InputError: where a record is refused; the file is named, and the rest is written.
        """
        from qs3.experiments.figures import picture
        from qs3.experiments.text import FORMATS

        filled = self.read()
        path = self.setup.out / f"{self.name}.md"
        for kind, make in FORMATS.items():
            write_text(path.with_suffix(f".{kind}"), make(filled))
        write_bytes(path.with_suffix(".png"), picture(filled, "png"))
        if filled.faults:
            raise InputError("; ".join(filled.faults))
        return path


def _take_out_mixed(records: dict[str, RunRecord], runs: Mapping[str, Run]) -> list[str]:
    """Take out records that read other data than the first of their domain, and name them."""
    firsts: dict[str, tuple[str, str]] = {}
    faults = []
    for name, run in runs.items():
        record = records.get(name)
        if record is None:
            continue
        data = {f"train {run.source}": record.source, f"test {run.target}": record.test}
        if record.target is not None:
            data[f"train {run.target}"] = record.target
        for part, read in data.items():
            checksum, where = firsts.setdefault(part, (read.checksum, name))
            if checksum != read.checksum:
                faults.append(f"{name}: read other data ({part}) than {where}; delete its record")
                records.pop(name, None)
    return faults


@dataclass(frozen=True)
class FilledTable:
    """A table with its numbers."""

    table: Table
    """What it is."""
    runs: Mapping[Place, Sequence[Run]]
    """Runs of each cell."""
    records: Mapping[str, RunRecord]
    """Records that are there, by the name of the run."""
    faults: tuple[str, ...] = ()
    """What is wrong with each record that was refused."""

    def made_part(self) -> "FilledTable":
        """Return the table with the rows and columns alone that have records."""
        places = [place for place in self.runs if self.records_of(place)]
        if not places:
            return self
        rows, columns = (tuple(dict.fromkeys(place[i] for place in places)) for i in (0, 1))
        return replace(self.table, rows=rows, columns=columns).read()

    def records_of(self, place: Place) -> list[RunRecord]:
        """Return the records of a cell, in the order of the seeds."""
        names = [run.name for run in self.runs[place]]
        return [self.records[name] for name in names if name in self.records]

    def frame(self) -> pd.DataFrame:
        """Return one line a run; see `qs3.evaluation.tables.frame`."""
        records = {place: self.records_of(place) for place in self.runs}
        fields = [
            {"row": row, "column": column} for row, column in records for _ in records[row, column]
        ]
        return frame([record for cell in records.values() for record in cell], fields)

    @cached_property
    def means(self) -> dict[Place, Mapping[str, Any]]:
        """Average of each cell that has runs; see `qs3.evaluation.tables.average`.

        Raises:
            InputError: where runs of a cell differ in more than their seed.
        """
        means = average(self.frame(), ["row", "column"])
        lines: list[Any] = means.to_dict("records")
        return {(mean["row"], mean["column"]): mean for mean in lines}

    def marks(self, place: Place) -> list[str]:
        """Return the caveats of a cell, such as ``transductive``, and rounds that were skipped."""
        mean = self.means.get(place)
        if mean is None:
            return []
        marks = [mark for mark in mean["marks"].split(", ") if mark]
        rounds, skipped = mean["rounds"], mean["rounds"] - mean["trained"]
        if skipped:
            # Such a cell says more of the network before the rounds than of them.
            marks.append(f"{skipped} of {rounds} rounds skipped, confident clouds too few")
        return marks

    @property
    def waiting(self) -> list[Place]:
        """Places that wait for runs."""
        return [p for p, runs in self.runs.items() if len(self.records_of(p)) < len(runs)]

    def differences(self) -> list[tuple[str, SeedComparison]]:
        """Return the comparisons for which there are runs of the same seeds."""
        rows, columns = self.table.headings()
        differences = []
        for what, first, second in self.table.experiment.pairs(self.table.setup.scale):
            cells: list[tuple[str, Place, Place]] = []
            if {first, second} <= {row.key for row in rows}:
                cells = [(c.title, (first, c.key), (second, c.key)) for c in columns]
            elif {first, second} <= {column.key for column in columns}:
                cells = [(r.title, (r.key, first), (r.key, second)) for r in rows]
            for title, *places in cells:
                difference = compare_seeds(*(self._by_seed(place) for place in places))
                if difference is not None:
                    differences.append((f"{what}, {title}", difference))
        return differences

    def _by_seed(self, place: Place) -> dict[int, float]:
        return {record.seed: record.scores.accuracy for record in self.records_of(place)}
