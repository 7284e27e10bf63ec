"""What an experiment is: a grid of cells, each of them runs that differ in their seed alone."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from qs3.evaluation.compare import SeedComparison, compare_seeds
from qs3.evaluation.metrics import MeanSEM, mean_sem
from qs3.evaluation.records import RunRecord, count_rounds
from qs3.experiments.runs import Run
from qs3.experiments.scales import Scale

Named = tuple[tuple[str, str], ...]
"""Keys with their headings, in order."""
Place = tuple[str, str]
"""Key of the row and key of the column of a cell."""


@dataclass(frozen=True)
class Experiment:
    """A table or figure of the paper, or one that it lacks."""

    name: str
    """Name on the command line, and of its files."""
    title: str
    """Heading."""
    source: str
    """Where the paper has it, and what its figures are."""
    rows: Callable[[Scale], Named]
    """Lines of the table."""
    columns: Callable[[Scale], Named]
    """Columns."""
    run: Callable[[Scale, str, str, int, int | None], Run | None]
    """The run of (scale, row, column, seed, threads); None where the table has no such cell."""
    published: Mapping[Place, tuple[float, float | None]] = field(default_factory=dict)
    """The paper's mean and standard error in per cent, by row and column."""
    pairs: Callable[[Scale], Sequence[tuple[str, Place, Place]]] = lambda scale: ()
    """Comparisons over seeds: what is compared, first cell, second cell."""
    notes: tuple[str, ...] = ()
    """What a reader must know."""
    corner: str = "network"
    """Heading of the first column."""
    made: tuple[str, ...] = ()
    """Domains that no data of the user can take the place of, since others are made beside them."""
    lines: tuple[tuple[str, str], ...] = ()
    """Panels of a figure of lines: beginning of the columns' keys and name of the axis; without
    them the figure has bars."""


@dataclass(frozen=True)
class Cell:
    """The runs of a row and a column."""

    accuracies: Mapping[int, float]
    """Accuracy by seed."""
    class_means: Mapping[int, float]
    """Class-mean accuracy by seed."""
    published: tuple[float, float | None] | None
    """The paper's mean and standard error, in per cent."""
    marks: tuple[str, ...] = ()
    """Caveats of its runs, such as ``transductive``, or that rounds of them were skipped."""
    wanted: int = 1
    """Runs that it waits for in all; 0 where the table has no such cell."""

    @property
    def accuracy(self) -> MeanSEM | None:
        """Mean accuracy over seeds; None without a run."""
        return mean_sem(list(self.accuracies.values())) if self.accuracies else None

    @property
    def class_mean(self) -> MeanSEM | None:
        """Mean class-mean accuracy over seeds; None without a run."""
        return mean_sem(list(self.class_means.values())) if self.class_means else None


@dataclass(frozen=True)
class Grid:
    """A table with its numbers."""

    experiment: Experiment
    """What it is."""
    scale: Scale
    """How large."""
    rows: Named
    """Lines."""
    columns: Named
    """Columns."""
    cells: Mapping[Place, Cell]
    """Every place of it."""

    @property
    def empty(self) -> list[Place]:
        """Places that wait for runs."""
        return [p for p, cell in self.cells.items() if len(cell.accuracies) < cell.wanted]

    def differences(self) -> list[tuple[str, SeedComparison]]:
        """Return the comparisons for which there are runs of the same seeds."""
        found = []
        for what, first, second in self.experiment.pairs(self.scale):
            if first in self.cells and second in self.cells:
                difference = compare_seeds(
                    self.cells[first].accuracies, self.cells[second].accuracies
                )
                if difference is not None:
                    found.append((what, difference))
        return found


def cell_runs(
    experiment: Experiment,
    scale: Scale,
    seeds: Sequence[int],
    threads: int | None = None,
    rows: Sequence[str] = (),
    columns: Sequence[str] = (),
) -> dict[Place, list[Run]]:
    """Return the runs of each cell, in order of the seeds.

    Args:
        experiment: The experiment.
        scale: Its size.
        seeds: Seeds of the trainings.
        threads: CPU threads of a training.
        rows: Keys of lines to take; empty takes all.
        columns: Keys of columns to take; empty takes all.
    """
    found: dict[Place, list[Run]] = {}
    for row, _ in experiment.rows(scale):
        for column, _ in experiment.columns(scale):
            if (rows and row not in rows) or (columns and column not in columns):
                continue
            runs = [experiment.run(scale, row, column, seed, threads) for seed in seeds]
            found[row, column] = [run for run in runs if run is not None]
    return found


def _marks(records: Sequence[RunRecord]) -> tuple[str, ...]:
    marks = sorted({mark for record in records for mark in record.marks})
    trained, rounds = count_rounds(records)
    if trained < rounds:
        # Such a cell says more of the network before the rounds than of them.
        marks.append(f"{rounds - trained} of {rounds} rounds skipped, confident clouds too few")
    return tuple(marks)


def fill(
    experiment: Experiment,
    scale: Scale,
    cells: Mapping[Place, Sequence[Run]],
    records: Mapping[str, RunRecord],
) -> Grid:
    """Put the scores of records into the cells of a table.

    Args:
        experiment: The experiment.
        scale: Its size.
        cells: Runs of each cell.
        records: Record of each run that has one, by its name.
    """
    wanted = set(cells)
    rows = tuple(r for r in experiment.rows(scale) if any(r[0] == p[0] for p in wanted))
    columns = tuple(c for c in experiment.columns(scale) if any(c[0] == p[1] for p in wanted))
    filled = {}
    for place, runs in cells.items():
        there = {run.seed: records[run.record] for run in runs if run.record in records}
        filled[place] = Cell(
            accuracies={seed: one.scores.accuracy for seed, one in there.items()},
            class_means={seed: one.scores.class_mean_accuracy for seed, one in there.items()},
            published=experiment.published.get(place),
            marks=_marks(list(there.values())),
            wanted=len(runs),
        )
    return Grid(experiment, scale, rows, columns, filled)
