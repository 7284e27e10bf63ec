"""Experiments: grids of cells, beside the published figures."""

import functools
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from importlib import import_module
from importlib.resources import files
from typing import Any

from qs3.errors import no_such
from qs3.paper import TABLES
from qs3.paper.domains import Kind
from qs3.paper.scales import NETWORKS, Scale
from qs3.runs.run import FOREST_MODEL

_TITLES = {
    "pointnet": "PointNet",
    "pointnet2": "PointNet++",
    "dgcnn": "DGCNN",
    "rscnn": "RS-CNN",
    "simpleview": "SimpleView",
    "simpleview-64": "SimpleView, 64 pixels",
    FOREST_MODEL: "Forest",
}


@dataclass(frozen=True)
class Heading:
    """A row or a column of a table."""

    key: str
    """Name on the command line and in the CSV file."""
    title: str
    fields: Mapping[str, Any] = field(default_factory=dict)
    """Fields of all its `qs3.paper.cells.Cell`."""
    axis: str = ""
    """Axis of a column in a figure of lines."""
    number: float = 0.0
    """Position on that axis."""


Headings = tuple[Heading, ...]


@dataclass(frozen=True)
class Experiment:
    """A table: a cell for each row, column and seed."""

    title: str
    rows: Headings
    columns: Headings
    """Columns; those with an axis make a figure of lines."""
    fields: Mapping[str, Any] = field(default_factory=dict)
    """Fields of all cells."""
    source: str = ""
    """Place in the paper, if the paper prints no figures."""
    published: str = ""
    """Printed figures: a table of ``published.toml``."""
    pairs: Sequence[tuple[str, str, str]] = ()
    """Comparisons over seeds: title, and the keys of two rows or columns, first minus second."""
    notes: tuple[str, ...] = ()
    corner: str = "network"
    fixed: tuple[Kind, ...] = ()
    """Domains that the user's data cannot replace, because others are made of the same meshes."""
    usual: Sequence[str] = ()
    """Keys of the default columns; empty makes all."""

    @property
    def paper(self) -> str:
        """Source of its published figures."""
        return self.source or published()[self.published]["source"]

    def published_cell(self, row: str, column: str) -> tuple[float, float] | None:
        """Return the paper's mean and standard error in per cent, whatever our network."""
        rows = published()[self.published].get(column, {}) if self.published else {}
        value = rows.get(row.partition("@")[0].removesuffix("-64"))
        return None if value is None else (value[0], value[1])


def load_experiment(name: str, scale: Scale) -> Experiment:
    """Return the experiment of a file of `qs3.paper.tables`."""
    if name not in TABLES:
        raise no_such(f"unknown table {name!r}", name, TABLES)
    module = import_module(f"qs3.paper.tables.{name.replace('-', '_')}")
    return module.experiment(scale)


def networks(scale: Scale) -> Headings:
    """Return the paper's networks as rows; the bench's comes first if it is another.

    Scales whose clouds have real sizes also have a forest, and SimpleView at fewer pixels.
    """
    names = [name for name in NETWORKS if name in scale.networks]
    if scale.train.preparation.size_input:
        names += ["simpleview-64", FOREST_MODEL]
    model = scale.train.model
    bench = () if model in NETWORKS else (Heading(model, _TITLES.get(model, model)),)
    return bench + tuple(Heading(name, _TITLES[name], {"network": name}) for name in names)


def tasks(*pairs: tuple[str, str]) -> Headings:
    """Return pairs of source and target as columns."""
    return tuple(
        Heading(f"{source}-{target}", f"{source} → {target}", {"source": source, "target": target})
        for source, target in pairs
    )


def lines(titles: Mapping[str, str]) -> Headings:
    """Return rows of `qs3.paper.cells.ROWS`, by their titles."""
    return tuple(Heading(row, title, {"row": row}) for row, title in titles.items())


@functools.cache
def published() -> Mapping[str, Any]:
    """Return the published figures in per cent: by table, column and row mean and error."""
    text = files("qs3.paper").joinpath("published.toml").read_text(encoding="utf-8")
    return tomllib.loads(text)
