"""Experiments: grids of runs, beside the published figures."""

import functools
import tomllib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from importlib.resources import files
from typing import Any

from qs3.errors import no_such
from qs3.experiments import TABLES
from qs3.experiments.domains import Domain, Kind
from qs3.experiments.runs import SUPERVISED, Run, make_run
from qs3.experiments.scales import NETWORKS, Scale
from qs3.experiments.setup import Setup
from qs3.training.run import FOREST_MODEL

Place = tuple[str, str]
"""Key of the row and key of the column of a cell."""
Published = tuple[float, float | None]
"""Mean and standard error in per cent; PointDA-10's have none."""
Pair = tuple[str, str, str]
"""Title, and the keys of two rows or columns: first minus second, rows in every column and columns
in every row."""
_TITLES = {
    "pointnet": "PointNet",
    "pointnet2": "PointNet++",
    "dgcnn": "DGCNN",
    "rscnn": "RS-CNN",
    "simpleview": "SimpleView",
    "simpleview-64": "SimpleView, 64 pixels",
    "forest": "Forest",
}


@dataclass(frozen=True)
class Heading:
    """A row or a column of a table."""

    key: str
    """Name on the command line and in the CSV file."""
    title: str
    fields: Mapping[str, Any] = field(default_factory=dict)
    """Arguments of `qs3.experiments.runs.make_run` for all its runs."""
    axis: str = ""
    """Axis of a column in a figure of lines."""
    number: float = 0.0
    """Position on that axis."""


Headings = tuple[Heading, ...]


@dataclass(frozen=True)
class Experiment:
    """A table with its figure: a run of each row in each column."""

    title: str
    rows: Callable[[Scale], Headings]
    columns: Callable[[Scale], Headings]
    """Columns; those with an axis make a figure of lines, the others one of bars."""
    fields: Mapping[str, Any] = field(default_factory=dict)
    """Arguments of `qs3.experiments.runs.make_run` for all runs."""
    source: str = ""
    """Place in the paper, if the paper prints no figures."""
    published: str = ""
    """Printed figures: a table of ``published.toml``."""
    published_as: Mapping[str, str] = field(default_factory=dict)
    """Published names of our rows, if they differ."""
    pairs: Callable[[Scale], Sequence[Pair]] = lambda scale: ()
    """Comparisons over seeds."""
    notes: tuple[str, ...] = ()
    corner: str = "network"
    """Heading of the first column."""
    made: tuple[Kind, ...] = ()
    """Domains that the user's data cannot replace, because others are made of the same meshes."""
    usual: Callable[[Scale], Sequence[str]] = lambda scale: ()
    """Keys of the default columns; empty makes all."""

    @property
    def paper(self) -> str:
        """Source of its published figures."""
        return self.source or published()[self.published]["source"]

    def published_cell(self, row: str, column: str) -> Published | None:
        """Return the paper's figures of a cell."""
        rows = published()[self.published].get(column, {}) if self.published else {}
        value = rows.get(self.published_as.get(row, row.removesuffix("-64")))
        return None if value is None else (value[0], value[1] if len(value) > 1 else None)

    def run(self, setup: Setup, row: Heading, column: Heading, seed: int) -> Run | None:
        """Return the run of a cell; None for the supervised row on real objects.

        Their labels are too few to spare any for a training.
        """
        fields = {**self.fields, **row.fields, **column.fields}
        if fields["row"] == SUPERVISED and fields["target"].kind in ("R", "U"):
            return None
        own, threads = setup.own, setup.threads
        return make_run(setup.scale, **fields, seed=seed, threads=threads, own=own)


def load_experiment(name: str) -> Experiment:
    """Return the experiment of a file of `qs3.experiments.tables`."""
    if name not in TABLES:
        raise no_such(f"unknown table {name!r}", name, TABLES)
    return import_module(f"qs3.experiments.tables.{name.replace('-', '_')}").EXPERIMENT


def networks(scale: Scale) -> Headings:
    """Return the paper's networks as lines; the bench's comes first if it is another.

    Scales whose clouds have real sizes also have a forest, and SimpleView at fewer pixels.
    """
    names = [name for name in NETWORKS if name in scale.networks]
    if scale.train.preparation.size_input:
        names += ["simpleview-64", FOREST_MODEL]
    own = scale.train.model
    bench = () if own in NETWORKS else (Heading(own, _TITLES.get(own, own), {}),)
    return bench + tuple(Heading(name, _TITLES[name], {"network": name}) for name in names)


def tasks(*pairs: tuple[Kind, Kind]) -> Headings:
    """Return pairs of source and target as columns."""
    return tuple(
        Heading(
            f"{source}-{target}",
            f"{source} → {target}",
            {"source": Domain(source), "target": Domain(target)},
        )
        for source, target in pairs
    )


def lines(titles: Mapping[str, str]) -> Headings:
    """Return rows of `qs3.experiments.runs.ROWS` as lines of a table, by their titles."""
    return tuple(Heading(row, title, {"row": row}) for row, title in titles.items())


@functools.cache
def published() -> Mapping[str, Any]:
    """Return the published figures in per cent: by table, column and row mean and error."""
    text = files("qs3.experiments").joinpath("published.toml").read_text(encoding="utf-8")
    return tomllib.loads(text)
