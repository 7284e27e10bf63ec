"""Point clouds drawn as plain scatter plots: own orthographic view, painter's order, shading.

Convention:
    World: right-handed, z up. A viewer at azimuth 0 and elevation 0 stands on −y and sees +x to
    the right and +z upwards (*front*); azimuth 90 stands on +x (*side*); elevation 90 looks down
    from +z with +x to the right (*top*). Angles are in degrees.
"""

from collections.abc import Mapping, Sequence

import matplotlib
import numpy as np
from jaxtyping import Float, Int
from matplotlib.axes import Axes
from matplotlib.figure import Figure

from qs3.report.figure import house_style, short, without_frame

SIDES = {"front": (0.0, 0.0), "side": (90.0, 0.0), "top": (0.0, 90.0)}
"""Azimuth and elevation of the three sides."""

_OBLIQUE = (30.0, 20.0)
_MAP = matplotlib.colormaps["viridis"]


def project(
    points: Float[np.ndarray, "n 3"], azimuth: float, elevation: float
) -> Float[np.ndarray, "n 3"]:
    """Turn points into the viewer's axes: right, up, towards the viewer.

    Example:
        >>> np.round(project(np.array([[1.0, 2.0, 3.0]]), *SIDES["front"]), 6).tolist()
        [[1.0, 3.0, -2.0]]
        >>> np.round(project(np.array([[1.0, 2.0, 3.0]]), *SIDES["top"]), 6).tolist()
        [[1.0, 2.0, 3.0]]
    """
    a, e = np.deg2rad([azimuth, elevation])
    right = np.array([np.cos(a), np.sin(a), 0.0])
    towards = np.array([np.sin(a) * np.cos(e), -np.cos(a) * np.cos(e), np.sin(e)])
    axes = np.stack([right, np.cross(towards, right), towards])
    return (points @ axes.T).astype(points.dtype)


def shade(
    height: Float[np.ndarray, "n"], nearness: Float[np.ndarray, "n"]
) -> Float[np.ndarray, "n 4"]:
    """Colour points by height, faded towards white with distance from the viewer.

    Args:
        height: World z; its range spans the colour map.
        nearness: Coordinate towards the viewer; its range spans the fade.
    """
    colours = np.array(_MAP(0.9 * _unit(height)))
    fade = 0.5 * (1.0 - _unit(nearness))[:, None]
    colours[:, :3] = colours[:, :3] * (1.0 - fade) + fade
    return colours


def draw_cloud(
    axes: Axes,
    points: Float[np.ndarray, "n 3"],
    azimuth: float,
    elevation: float,
    limits: tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]] | None = None,
) -> None:
    """Scatter one cloud on ``axes``, far points first; rows that are not finite are left out.

    Args:
        axes: Where to draw.
        points: World points.
        azimuth: Viewer's azimuth in degrees.
        elevation: Viewer's elevation in degrees.
        limits: Lowest and highest corner of the box to frame, so that several clouds share a
            scale; default: that of the points.
    """
    points = points[np.isfinite(points).all(axis=1)]
    seen = project(points, azimuth, elevation)
    order = np.argsort(seen[:, 2], kind="stable")
    colours = shade(points[:, 2], seen[:, 2])
    axes.scatter(seen[order, 0], seen[order, 1], s=4.0, c=colours[order], linewidths=0)
    axes.set_aspect("equal")
    without_frame(axes)
    if limits is None and len(points):
        limits = points.min(axis=0), points.max(axis=0)
    if limits is not None:
        corners = np.stack(np.meshgrid(*np.stack(limits, axis=1)), axis=-1).reshape(-1, 3)
        shadow = project(corners, azimuth, elevation)
        low, high = shadow.min(axis=0), shadow.max(axis=0)
        pad = 0.04 * float((high - low)[:2].max()) + 1e-9
        axes.set_xlim(float(low[0]) - pad, float(high[0]) + pad)
        axes.set_ylim(float(low[1]) - pad, float(high[1]) + pad)


def samples_per_class(
    points: Float[np.ndarray, "b n 3"],
    labels: Int[np.ndarray, "b"],
    class_names: Sequence[str],
    count: int = 4,
) -> dict[str, list[np.ndarray]]:
    """Return the first ``count`` clouds of each class, by class name.

    Example:
        >>> samples = samples_per_class(np.zeros((3, 5, 3)), np.array([1, 1, 0]), ["a", "b"], 1)
        >>> {name: len(clouds) for name, clouds in samples.items()}
        {'a': 1, 'b': 1}
    """
    return {
        name: [points[i] for i in np.flatnonzero(labels == index)[:count]]
        for index, name in enumerate(class_names)
    }


@house_style
def gallery(
    samples: Mapping[str, Sequence[Float[np.ndarray, "_ 3"]]],
    title: str = "",
    columns: int = 4,
) -> Figure:
    """Draw a grid of clouds: one row a class, up to ``columns`` clouds a row, each fitted.

    Args:
        samples: Clouds of each class, by class name; they may differ in their number of points.
        title: Heading.
        columns: Clouds a row; more are left out.
    """
    names, rows = [short(name) for name in samples], len(samples)
    cell, left, top = 0.95, 0.25 + 0.09 * max(map(len, names)), 0.35  # inches
    width, height = left + cell * columns, top + cell * rows
    figure = Figure(figsize=(width, height))
    axes = figure.add_axes((left / width, 0.0, 1.0 - left / width, 1.0 - top / height))
    spots, colours = [], []
    for row, clouds in enumerate(samples.values()):
        if not clouds:
            axes.text(0.0, -row, "none", ha="center", va="center", color="#666666")
        for column, cloud in enumerate(clouds[:columns]):
            cloud = cloud[np.isfinite(cloud).all(axis=1)]
            if not len(cloud):
                continue
            seen = project(np.asarray(cloud, np.float64), *_OBLIQUE)
            low, high = seen.min(axis=0), seen.max(axis=0)
            scale = 0.92 / max(float((high - low)[:2].max()), 1e-12)
            flat = (seen - (low + high) / 2.0)[:, :2] * scale + [column, -row]
            order = np.argsort(seen[:, 2], kind="stable")
            spots.append(flat[order])
            colours.append(shade(cloud[:, 2], seen[:, 2])[order])
    if spots:
        spot = np.concatenate(spots)
        axes.scatter(spot[:, 0], spot[:, 1], s=1.6, c=np.concatenate(colours), linewidths=0)
    axes.set_xlim(-0.5, columns - 0.5)
    axes.set_ylim(0.5 - rows, 0.5)
    axes.set_title(short(title, 40))
    without_frame(axes)
    axes.set_yticks(-np.arange(rows), names)
    axes.tick_params(axis="y", length=0)
    return figure


def _unit(values: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    """Scale values to 0 … 1; all equal values become 1."""
    if not len(values):
        return values
    low, high = values.min(), values.max()
    return (values - low) / (high - low) if high > low else np.ones_like(values)
