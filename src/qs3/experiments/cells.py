"""Headings and published figures that experiments share."""

from collections.abc import Mapping
from typing import Any

from qs3.experiments.bench_table import published
from qs3.experiments.experiment import Named, Place
from qs3.experiments.rows import NETWORKS
from qs3.experiments.scales import Scale

_TITLES = {
    "pointnet2": "PointNet++",
    "dgcnn": "DGCNN",
    "rscnn": "RS-CNN",
    "simpleview": "SimpleView",
}


def networks(scale: Scale) -> Named:
    """Return the paper's networks as lines of a table."""
    return tuple((name, _TITLES[name]) for name in NETWORKS if name in scale.networks)


def tasks(*names: str) -> Named:
    """Return tasks as columns.

    Example:
        >>> tasks("M-D", "S-F")
        (('M-D', 'M → D'), ('S-F', 'S → F'))
    """
    return tuple((name, name.replace("-", " → ")) for name in names)


def published_cells(
    table: str, names: Mapping[str, str] | None = None
) -> dict[Place, tuple[float, float | None]]:
    """Return published means and standard errors by row and column.

    Args:
        table: Name among the published figures; "" takes the tables of methods.
        names: Our key of a published row, where it is another.

    Example:
        >>> published_cells("real2sim")["dgcnn", "D-S"]
        (76.7, 0.3)
    """
    told: Mapping[str, Any] = published() if not table else published()[table]
    found: dict[Place, tuple[float, float | None]] = {}
    for column, rows in told.items():
        if isinstance(rows, dict) and "-" in column:
            for row, values in rows.items():
                mean, *sem = values
                key: str = names.get(row, row) if names else row
                found[key, column] = (mean, sem[0] if sem else None)
    return found


def published_source(table: str) -> str:
    """Return where the figures of a table were published."""
    return (published() if not table else published()[table])["source"]
