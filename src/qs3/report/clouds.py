"""Point clouds drawn as plain scatter plots: own orthographic view, painter's order, shading.

Each has ground (a shadow, or a line from the side) and a bar for scale, in the unit of the points.

Convention:
    World: right-handed, z up. A viewer at azimuth 0 and elevation 0 stands on −y and sees +x to
    the right and +z upwards (*front*); azimuth 90 stands on +x (*side*); elevation 90 looks down
    from +z with +x to the right (*top*). Angles are in degrees.
"""

from collections.abc import Mapping, Sequence

import matplotlib
import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.font_manager import findfont, get_font

from qs3.escapes import printable
from qs3.report.figure import house_style, short, without_frame

SIDES = {"front": (0.0, 0.0), "side": (90.0, 0.0), "top": (0.0, 90.0)}
"""Azimuth and elevation of the three sides."""

_OBLIQUE = (30.0, 20.0)
_MAP = matplotlib.colormaps["viridis"]
_GROUND, _SHADOW = "#999999", "#dddddd"
_FILLED, _RAISED = 0.84, 0.06  # of a cell: what a cloud takes, and how far above its middle
_LETTERS = 17  # of a caption


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


def viewer_towards(direction: Float[np.ndarray, "3"]) -> tuple[float, float]:
    """Return azimuth and elevation of a viewer who stands in a direction.

    Example:
        >>> viewer_towards(np.array([2.0, 0.0, 2.0]))
        (90.0, 45.0)
    """
    x, y, z = direction
    across = np.hypot(x, y)
    return float(np.degrees(np.arctan2(x, -y))), float(np.degrees(np.arctan2(z, across)))


def shade(
    height: Float[np.ndarray, "n"], nearness: Float[np.ndarray, "n"]
) -> Float[np.ndarray, "n 4"]:
    """Colour points by world z, faded towards white with distance from the viewer.

    The range of each spans the colour map and the fade.
    """
    colours = np.array(_MAP(0.8 * _unit(height)))  # the map's end is too light for white paper
    fade = 0.25 * (1.0 - _unit(nearness))[:, None]
    colours[:, :3] = colours[:, :3] * (1.0 - fade) + fade
    return colours


def draw_cloud(
    axes: Axes,
    points: Float[np.ndarray, "n 3"],
    azimuth: float,
    elevation: float,
    limits: tuple[Float[np.ndarray, "3"], Float[np.ndarray, "3"]] | None = None,
    unit: str = "",
) -> None:
    """Scatter one cloud on ``axes``, far points first; rows that are not finite are left out.

    ``limits`` are the lowest and highest corner of the box to frame, so that several clouds share a
    scale; by default those of the points. ``unit`` stands behind the number of the bar.
    """
    points = points[np.isfinite(points).all(axis=1)]
    seen = project(points, azimuth, elevation)
    order = np.argsort(seen[:, 2], kind="stable")
    colours = shade(points[:, 2], seen[:, 2])
    axes.scatter(seen[order, 0], seen[order, 1], s=7.0, c=colours[order], linewidths=0)
    axes.set_aspect("equal")
    without_frame(axes)
    if limits is None and len(points):
        limits = points.min(axis=0), points.max(axis=0)
    if limits is not None:
        corners = np.stack(np.meshgrid(*np.stack(limits, axis=1)), axis=-1).reshape(-1, 3)
        shadow = project(corners, azimuth, elevation)
        low, high = shadow.min(axis=0), shadow.max(axis=0)
        pad = 0.06 * float((high - low)[:2].max()) + 1e-9
        axes.set_xlim(float(low[0]) - pad, float(high[0]) + pad)
        axes.set_ylim(float(low[1]) - 2 * pad, float(high[1]) + pad)
        if not elevation:
            axes.axhline(float(limits[0][2]), color=_GROUND, linewidth=0.8, zorder=0)
        bar = bar_length(float(high[0] - low[0]))
        _draw_bar(axes, float(low[0]), float(low[1]) - pad, bar, f"{bar:g}{unit}")


@house_style
def gallery(
    samples: Mapping[str, Sequence[Float[np.ndarray, "_ 3"]]],
    title: str = "",
    columns: int = 4,
) -> Figure:
    """Draw a grid of clouds: one row per class, up to ``columns`` clouds per row, each fitted.

    Clouds may differ in their number of points.
    """
    names, rows = [short(name) for name in samples], len(samples)
    # Inches.
    cell, left, top = 1.05, 0.25 + 0.09 * max(map(len, names), default=0), 0.35 * bool(title)
    width, height = left + cell * columns, top + cell * rows
    figure = Figure(figsize=(width, height))
    axes = figure.add_axes((left / width, 0.0, 1.0 - left / width, 1.0 - top / height))
    spots, shadows, colours = [], [], []
    for row, clouds in enumerate(samples.values()):
        middle = float(-row)
        if not clouds:
            axes.text(0.0, middle, "none", ha="center", va="center", color="#666666")
        for column, cloud in enumerate(clouds[:columns]):
            cloud = cloud[np.isfinite(cloud).all(axis=1)]
            if not len(cloud):
                continue
            cloud = np.asarray(cloud, np.float64)
            ground = np.c_[cloud[:, :2], np.full(len(cloud), cloud[:, 2].min())]
            seen, shadow = project(cloud, *_OBLIQUE), project(ground, *_OBLIQUE)
            both = np.concatenate([seen, shadow])[:, :2]
            low, high = both.min(axis=0), both.max(axis=0)
            scale = _FILLED / max(float((high - low).max()), 1e-12)
            place = np.array([column, middle + _RAISED])
            order = np.argsort(seen[:, 2], kind="stable")
            spots.append(((seen[:, :2] - (low + high) / 2.0) * scale + place)[order])
            shadows.append((shadow[:, :2] - (low + high) / 2.0) * scale + place)
            colours.append(shade(cloud[:, 2], seen[:, 2])[order])
            bar = bar_length(0.9 / scale)
            if _FILLED / scale > 1e-9:
                _draw_bar(axes, column - 0.45, middle - 0.43, bar * scale, f"{bar:g}")
    if spots:
        spot, shadow = np.concatenate(spots), np.concatenate(shadows)
        axes.scatter(spot[:, 0], spot[:, 1], s=4.0, c=np.concatenate(colours), linewidths=0)
        axes.scatter(shadow[:, 0], shadow[:, 1], s=5.0, c=_SHADOW, linewidths=0, zorder=0.5)
    axes.set(xlim=(-0.5, columns - 0.5), ylim=(0.5 - rows, 0.5), title=short(title, 40))
    without_frame(axes)
    axes.set_yticks(-np.arange(rows), names)
    axes.tick_params(axis="y", length=0)
    return figure


def bar_length(room: float) -> float:
    """Return the length of a bar for scale: 1, 2 or 5 times a power of ten, up to 0.4 of the room.

    Example:
        >>> bar_length(1.0), bar_length(0.06)
        (0.2, 0.02)
    """
    power = 10.0 ** np.floor(np.log10(max(0.4 * room, 1e-12)))
    step = max((s for s in (1, 2, 5) if s * power <= 0.4 * room), default=1)
    return float(f"{step * power:.3g}")


def caption(text: str) -> str:
    """Cut a name in its middle to fit below a picture: files often differ at the end."""
    font = get_font(findfont("DejaVu Sans"))
    text = "".join(c if font.get_char_index(ord(c)) else "□" for c in printable(text, keep=""))
    if len(text) <= _LETTERS:
        return text
    end = 2 * _LETTERS // 3
    return f"{text[: _LETTERS - 1 - end]}…{text[-end:]}"


def _draw_bar(axes: Axes, x: float, y: float, length: float, text: str) -> None:
    axes.plot([x, x + length], [y, y], color="#333333", linewidth=1.4, solid_capstyle="butt")
    axes.annotate(
        text, (x + length, y), (3, 0), textcoords="offset points", va="center", fontsize=7.5,
        color="#333333", annotation_clip=False,
    )  # fmt: skip


def _unit(values: Float[np.ndarray, "n"]) -> Float[np.ndarray, "n"]:
    """Scale values to 0 … 1; all equal values become 1."""
    if not len(values):
        return values
    low, high = values.min(), values.max()
    return (values - low) / (high - low) if high > low else np.ones_like(values)
