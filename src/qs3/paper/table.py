"""A table of a folder: its cells, and the numbers of their records."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import product
from typing import Any

import pandas as pd

from qs3.errors import InputError
from qs3.evaluation.metrics import SeedComparison, compare_seeds
from qs3.evaluation.records import RunRecord
from qs3.evaluation.tables import average, frame
from qs3.paper.cells import SUPERVISED, Cell, make_cell
from qs3.paper.experiment import Experiment, Headings, load_experiment
from qs3.paper.grid import find_result, read_results
from qs3.paper.setup import Setup

Place = tuple[str, str]
"""Key of the row and key of the column of a cell."""


@dataclass(frozen=True)
class Table:
    """A table; it reads the records of its folder once."""

    name: str
    setup: Setup
    rows: tuple[str, ...] = ()
    """Keys of lines; empty takes all."""
    columns: tuple[str, ...] = ()
    """Keys of columns; empty takes the experiment's usual ones."""

    @cached_property
    def experiment(self) -> Experiment:
        """Definition of the table."""
        return load_experiment(self.name, self.setup.scale)

    @cached_property
    def headings(self) -> tuple[Headings, Headings]:
        """Rows and columns."""
        experiment = self.experiment
        parts, keys = (experiment.rows, experiment.columns), (self.rows, self.columns)
        wanted = keys[0], keys[1] or experiment.usual
        kept, shown = (
            tuple(heading for heading in part if not chosen or heading.key in chosen)
            for part, chosen in zip(parts, wanted, strict=True)
        )
        if mixed := sorted(set(experiment.fixed) & set(self.setup.data)):
            raise InputError(
                f"{self.name}: compares {', '.join(mixed)} with what is made here of the same "
                "meshes; leave out that --data"
            )
        if not kept or not shown:
            names = [", ".join(heading.key for heading in part) for part in parts]
            raise InputError(f"{self.name}: its lines are {names[0]}; its columns are {names[1]}")
        return kept, shown

    @cached_property
    def cells(self) -> Mapping[Place, Sequence[Cell]]:
        """Cells of each place, in the order of the seeds.

        The supervised row has none on real objects, whose labels are too few to spare any.
        """
        cells: dict[Place, list[Cell]] = {}
        for row, column in product(*self.headings):
            fields = {**self.experiment.fields, **row.fields, **column.fields}
            none = fields["row"] == SUPERVISED and fields["target"] in ("R", "U")
            cells[row.key, column.key] = [
                make_cell(self.setup, **fields, seed=seed) for seed in self.setup.seeds if not none
            ]
        return cells

    @property
    def all_cells(self) -> list[Cell]:
        """Cells of all places, each once."""
        return list(dict.fromkeys(cell for cells in self.cells.values() for cell in cells))

    @cached_property
    def _read(self) -> tuple[Mapping[Cell, RunRecord], Sequence[str]]:
        results, faults = read_results(self.setup)
        records: dict[Cell, RunRecord] = {}
        firsts: dict[str, tuple[str, Cell]] = {}
        for cell in self.all_cells:
            try:
                record = find_result(cell, self.setup, results)
                if record is not None:
                    _require_same_data(cell, record, firsts)
                    records[cell] = record
            except InputError as error:
                faults.append(str(error))
        return records, faults

    records = property(lambda self: self._read[0], doc="Existing records, by cell.")
    faults = property(lambda self: self._read[1], doc="A message for each refused record.")

    def with_records(self) -> "Table":
        """Return the table with only the rows and columns that have records."""
        rows, columns = (tuple(dict.fromkeys(place[i] for place in self.means)) for i in (0, 1))
        return replace(self, rows=rows, columns=columns)

    def records_of(self, place: Place) -> list[RunRecord]:
        """Return the records of a place, in the order of the seeds."""
        return [self.records[cell] for cell in self.cells[place] if cell in self.records]

    @cached_property
    def lines(self) -> pd.DataFrame:
        """One line per record; see `qs3.evaluation.tables.frame`."""
        found = [(place, record) for place in self.cells for record in self.records_of(place)]
        fields = [{"row": row, "column": column} for (row, column), _ in found]
        return frame([record for _, record in found], fields)

    @cached_property
    def means(self) -> Mapping[Place, Mapping[str, Any]]:
        """Average of each place that has records; see `qs3.evaluation.tables.average`."""
        means: list[Any] = average(self.lines, ["row", "column"]).to_dict("records")
        return {(mean["row"], mean["column"]): mean for mean in means}

    def marks(self, place: Place) -> list[str]:
        """Return the caveats of a place, such as ``transductive``, and the skipped rounds."""
        mean = self.means.get(place, {"marks": "", "rounds": 0, "trained": 0})
        marks = [mark for mark in mean["marks"].split(", ") if mark]
        if skipped := mean["rounds"] - mean["trained"]:  # a cell about the network before them
            words = "rounds skipped, confident clouds too few"
            marks.append(f"{skipped} of {mean['rounds']} {words}")
        return marks

    @property
    def waiting(self) -> list[Place]:
        """Places that lack records."""
        return [p for p, cells in self.cells.items() if len(self.records_of(p)) < len(cells)]

    def differences(self) -> list[tuple[str, SeedComparison]]:
        """Return the comparisons that have records of the same seeds."""
        rows, columns = self.headings
        differences = []
        for what, first, second in self.experiment.pairs:
            places: list[tuple[str, Place, Place]] = []
            if {first, second} <= {row.key for row in rows}:
                places = [(c.title, (first, c.key), (second, c.key)) for c in columns]
            elif {first, second} <= {column.key for column in columns}:
                places = [(r.title, (r.key, first), (r.key, second)) for r in rows]
            for title, *both in places:
                records = map(self.records_of, both)
                scores = ({one.seed: one.scores.accuracy for one in same} for same in records)
                if difference := compare_seeds(*scores):
                    differences.append((f"{what}, {title}", difference))
        return differences


def _require_same_data(cell: Cell, record: RunRecord, firsts: dict[str, tuple[str, Cell]]) -> None:
    data = {f"train {cell.source_name}": record.source, f"test {cell.target_name}": record.test}
    if record.target is not None:
        data[f"train {cell.target_name}"] = record.target
    for part, read in data.items():
        checksum, first = firsts.setdefault(part, (read.checksum, cell))
        if checksum != read.checksum:
            raise InputError(
                f"{cell.name}: read other data ({part}) than {first.name}; delete its record"
            )
