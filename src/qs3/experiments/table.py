"""A table of a folder: its runs, and the numbers of their records."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
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


@dataclass(frozen=True)
class Table:
    """A table with its figure; it reads the records of its folder once."""

    name: str
    setup: Setup
    rows: tuple[str, ...] = ()
    """Keys of lines; empty takes all."""
    columns: tuple[str, ...] = ()
    """Keys of columns; empty takes the experiment's usual ones."""

    @property
    def experiment(self) -> Experiment:
        """Definition of the table."""
        return load_experiment(self.name)

    @cached_property
    def headings(self) -> tuple[Headings, Headings]:
        """Rows and columns."""
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

    @cached_property
    def cells(self) -> Mapping[Place, Sequence[Run]]:
        """Runs of each cell, in the order of the seeds."""
        rows, columns = self.headings
        cells: dict[Place, list[Run]] = {}
        for row in rows:
            for column in columns:
                runs = [self.experiment.run(self.setup, row, column, n) for n in self.setup.seeds]
                cells[row.key, column.key] = [run for run in runs if run is not None]
        return cells

    def runs(self) -> list[Run]:
        """Return the runs of all cells, a warm-up before the runs that start from it."""
        wanted: dict[str, Run] = {}
        for seed in self.setup.seeds:  # a seed is finished before the next begins
            for run in (run for runs in self.cells.values() for run in runs if run.seed == seed):
                for part in run.parts:
                    if part is not None:
                        part.locate(self.setup.out, self.setup.shared)
                for needed in (run.warm_up, run):
                    if needed is not None:
                        wanted.setdefault(needed.name, needed)
        return list(wanted.values())

    @cached_property
    def _read(self) -> tuple[dict[str, RunRecord], list[str]]:
        results, faults = read_results(self.setup)
        records: dict[str, RunRecord] = {}
        firsts: dict[str, tuple[str, str]] = {}
        for run in {run.name: run for runs in self.cells.values() for run in runs}.values():
            try:
                record = find_result(run, self.setup, results)
                if record is not None:
                    _require_same_data(run, record, firsts)
                    records[run.name] = record
            except InputError as error:
                faults.append(str(error))
        return records, faults

    @property
    def records(self) -> Mapping[str, RunRecord]:
        """Existing records, by the name of the run."""
        return self._read[0]

    @property
    def faults(self) -> Sequence[str]:
        """A message for each record that is refused."""
        return self._read[1]

    def made_part(self) -> "Table":
        """Return the table with only the rows and columns that have records."""
        places = [place for place in self.cells if self.records_of(place)]
        if not places:
            return self
        rows, columns = (tuple(dict.fromkeys(place[i] for place in places)) for i in (0, 1))
        return replace(self, rows=rows, columns=columns)

    def records_of(self, place: Place) -> list[RunRecord]:
        """Return the records of a cell, in the order of the seeds."""
        names = [run.name for run in self.cells[place]]
        return [self.records[name] for name in names if name in self.records]

    def frame(self) -> pd.DataFrame:
        """Return one line a run; see `qs3.evaluation.tables.frame`."""
        lines = [
            (record, {"row": row, "column": column})
            for row, column in self.cells
            for record in self.records_of((row, column))
        ]
        return frame([record for record, _ in lines], [fields for _, fields in lines])

    @cached_property
    def means(self) -> Mapping[Place, Mapping[str, Any]]:
        """Average of each cell that has runs; see `qs3.evaluation.tables.average`."""
        lines: list[Any] = average(self.frame(), ["row", "column"]).to_dict("records")
        return {(mean["row"], mean["column"]): mean for mean in lines}

    def marks(self, place: Place) -> list[str]:
        """Return the caveats of a cell, such as ``transductive``, and the skipped rounds."""
        mean = self.means.get(place)
        if mean is None:
            return []
        marks = [mark for mark in mean["marks"].split(", ") if mark]
        rounds, skipped = mean["rounds"], mean["rounds"] - mean["trained"]
        if skipped:
            # Such a cell is about the network before the rounds.
            marks.append(f"{skipped} of {rounds} rounds skipped, confident clouds too few")
        return marks

    @property
    def waiting(self) -> list[Place]:
        """Places that lack runs."""
        return [p for p, runs in self.cells.items() if len(self.records_of(p)) < len(runs)]

    def differences(self) -> list[tuple[str, SeedComparison]]:
        """Return the comparisons that have runs of the same seeds."""
        rows, columns = self.headings
        differences = []
        for what, first, second in self.experiment.pairs(self.setup.scale):
            cells: list[tuple[str, Place, Place]] = []
            if {first, second} <= {row.key for row in rows}:
                cells = [(c.title, (first, c.key), (second, c.key)) for c in columns]
            elif {first, second} <= {column.key for column in columns}:
                cells = [(r.title, (r.key, first), (r.key, second)) for r in rows]
            for title, *places in cells:
                difference = compare_seeds(*map(self._by_seed, places))
                if difference is not None:
                    differences.append((f"{what}, {title}", difference))
        return differences

    def _by_seed(self, place: Place) -> dict[int, float]:
        return {record.seed: record.scores.accuracy for record in self.records_of(place)}


def _require_same_data(run: Run, record: RunRecord, firsts: dict[str, tuple[str, str]]) -> None:
    data = {f"train {run.source}": record.source, f"test {run.target}": record.test}
    if record.target is not None:
        data[f"train {run.target}"] = record.target
    for part, read in data.items():
        checksum, where = firsts.setdefault(part, (read.checksum, run.name))
        if checksum != read.checksum:
            raise InputError(
                f"{run.name}: read other data ({part}) than {where}; delete its record"
            )
