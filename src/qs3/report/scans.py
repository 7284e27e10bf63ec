"""Sheets of scans with their captions and the CAD laid onto them; scenes with their objects."""

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Int
from matplotlib.collections import LineCollection
from matplotlib.colors import LightSource
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Rectangle

from qs3.clouds.files import is_scene
from qs3.frames.camera_files import read_intrinsics
from qs3.objects.cut import upright
from qs3.objects.scene_files import Draw, SceneSettings
from qs3.objects.segment import SegmentedObject
from qs3.report.clouds import caption, draw_cloud, project, viewer_towards
from qs3.report.figure import (
    MARK,
    check_picture,
    class_colour,
    house_style,
    png_bytes,
    short,
    without_frame,
    write_png,
)

if TYPE_CHECKING:
    from qs3.answers.answer import Answer

POSES = "poses.png"
"""The first page of `draw_poses`."""
_MARK = f"{MARK} of scans"  # pages of an earlier call go, other pictures of their names stay
_COLUMNS, _A_PAGE = 5, 30
_WIDE, _HIGH, _TITLE, _SIDE = 2.2, 2.4, 0.4, 0.08
"""Inches of a tile, of the caption above its picture, and beside it: a layout that matplotlib
chooses takes as long as the drawing."""
_ELEVATION = 40.0
_EDGE, _LOST = "#cc3311", "#888888"  # dashes do not show on curves of many short edges
_SCAN = "#31688e"
_MEANING = ("scan", "edges of CAD", "edges of CAD, lost: pose not believed", "x y z: axes of CAD")
_LEGEND, _ARROW = 0.3, 0.25
"""Inches of the legend below all tiles, and of an axis."""
_CELLS = 500
"""Cells along the longer side of a cloud's picture."""


@dataclass(frozen=True)
class Tile:
    """A scan of the sheet."""

    points: Float[np.ndarray, "n 3"]
    caption: str
    edges: Float[np.ndarray, "e 2 3"] | None = None
    """Ends of the CAD's edges, laid onto the scan."""
    camera: Float[np.ndarray, "3"] | None = None
    """Place of the camera, known or likely."""
    lost: bool = False
    """Whether the pose of the edges is not believed; they are grey then."""
    turn: Float[np.ndarray, "3 3"] | None = None
    """Rotation of the CAD, whose axes are drawn in the corner."""

    @classmethod
    def of(cls, answer: "Answer", text: str) -> "Tile":
        """Return the scan of an answer, which is to have one, and its CAD."""
        assert answer.points is not None  # noqa: S101
        turn = None if answer.pose is None else answer.pose[:3, :3]
        return cls(answer.points, text, answer.drawn(), answer.eye, answer.lost, turn)


@house_style
def scan_sheet(tiles: Sequence[Tile]) -> Figure:
    """Draw scans in rows, each to a scale of its own, with edges from the side the camera saw."""
    rows, below = -(-len(tiles) // _COLUMNS), 0.0
    if any(tile.edges is not None for tile in tiles):
        below = _LEGEND
    height = _HIGH * rows + below
    figure = Figure(figsize=(_WIDE * _COLUMNS, height))
    if below:
        marks = [Line2D([], [], color=_SCAN, marker="o", linestyle="")]
        marks += [Line2D([], [], color=colour) for colour in (_EDGE, _LOST, "none")]
        figure.legend(marks, _MEANING, loc="lower center", ncols=4, frameon=False, fontsize=7.5)
    for number, tile in enumerate(tiles):
        row, column = divmod(number, _COLUMNS)
        left, low = _WIDE * column + _SIDE, below + _HIGH * (rows - 1 - row) + _SIDE
        wide, high = _WIDE - 2 * _SIDE, _HIGH - _TITLE - _SIDE
        total = _WIDE * _COLUMNS
        axes = figure.add_axes((left / total, low / height, wide / total, high / height))
        azimuth, elevation, framed = 30.0, _ELEVATION, tile.points
        if tile.camera is not None:
            azimuth, elevation = viewer_towards(tile.camera - tile.points.mean(axis=0))
        if tile.edges is not None and len(tile.edges):
            ends = tile.edges.reshape(-1, 3)
            framed = np.concatenate([framed, ends])
            lines = project(1000 * ends, azimuth, elevation)[:, :2].reshape(-1, 2, 2)
            colour = _LOST if tile.lost else _EDGE
            axes.add_collection(LineCollection([*lines], colors=colour, linewidths=0.6, zorder=2))
        limits = 1000 * framed.min(axis=0), 1000 * framed.max(axis=0)
        draw_cloud(axes, 1000 * tile.points, azimuth, elevation, limits, " mm")
        axes.set_title(tile.caption, fontsize=7.5)
        if tile.turn is not None:
            x, y = 72 * (left + wide - _ARROW), 72 * (low + _ARROW)
            ways = 60 * _ARROW * project(tile.turn.T, azimuth, elevation)
            for letter, (right, up, _) in zip("xyz", ways.tolist(), strict=True):
                axes.annotate(
                    letter, (x, y), (x + right, y + up), "figure points", "figure points",
                    {"arrowstyle": "-", "lw": 0.8, "shrinkA": 4, "shrinkB": 0},
                    ha="center", va="center", fontsize=6,
                )  # fmt: skip
    return figure


def write_sheets(path: Path, tiles: Sequence[Tile]) -> list[Path]:
    """Write scans thirty per page: ``path``, and for more of them -2, -3 … before its ending.

    Removes `earlier_sheets`, but not those of a table of their own name beside them.
    """
    earlier = earlier_sheets(path)
    more = range(2, -(-len(tiles) // _A_PAGE) + 1)
    pages = [path, *(path.with_stem(f"{path.stem}-{number}") for number in more)][: len(tiles)]
    for number, page in enumerate(pages):
        sheet = scan_sheet(tiles[number * _A_PAGE : (number + 1) * _A_PAGE])
        write_png(page, sheet, dpi=110, mark=_MARK)
    for page in {*earlier} - {*pages}:
        if not page.with_suffix(".csv").exists():
            page.unlink()
    return pages


def earlier_sheets(path: Path) -> list[Path]:
    """Return pages of an earlier `write_sheets`; raise InputError if one is another's picture."""
    name = re.compile(rf"{re.escape(path.stem)}(-([2-9]|[1-9]\d{{1,2}}))?")
    pages = [file for file in path.parent.glob(f"*{path.suffix}") if name.fullmatch(file.stem)]
    for page in pages:
        check_picture(page, _MARK)
    return pages


def draw_poses(folder: Path, answers: "Sequence[Answer]") -> list[Path]:
    """Draw the CAD of each answer over its cloud, in `POSES` of the folder.

    The most doubtful come first (`Answer.order`).
    """
    tiles, names = [], Counter(answer.file.name for answer in answers)
    for answer in sorted(answers, key=lambda answer: answer.order):
        if answer.points is None or answer.found is None:
            continue
        (name, share), *_ = answer.best()
        file = answer.file
        # Segmented scans are called object_003.ply in every folder.
        if names[file.name] > 1 or is_scene(file.parent):
            label = f"{caption(file.parent.name)}/{caption(file.name)}"
        else:
            label = caption(file.name)
        text = f"{label}\n{short(name)} {share:.2f}"
        text += f", {1000 * answer.found.residual:.1f} mm, visible {answer.found.visible:.0%}"
        text += ", lost" if answer.lost else ""
        tiles.append(Tile.of(answer, text))
    return write_sheets(folder / POSES, tiles)


def draw_scene(settings: SceneSettings) -> Draw:
    """Return a function that draws scenes: depth images as the camera sees them, clouds from above.

    The box of ``object_003.ply`` has the number 3.
    """

    def draw(points: Float[np.ndarray, "n 3"], objects: Sequence[SegmentedObject]) -> bytes:
        flat, height = points[:, :2], points[:, 2]
        edge = length = float(np.ptp(flat, axis=0).max()) / _CELLS
        if settings.intrinsics:
            camera = read_intrinsics(settings.intrinsics)
            seen = points @ upright(settings.gravity)
            height, edge = -seen[:, 2], float(settings.stride)
            flat = seen[:, :2] / seen[:, 2:] * (camera.fx, -camera.fy)
            length = edge * float(np.median(seen[:, 2])) / camera.fx
        figure = scene_figure(flat, height, edge, length, [item.rows for item in objects])
        return png_bytes(figure, dpi=110)

    return draw


@house_style
def scene_figure(
    flat: Float[np.ndarray, "n 2"],
    height: Float[np.ndarray, "n"],
    edge: float,
    length: float,
    objects: Sequence[Int[np.ndarray, "_"]],
) -> Figure:
    """Draw the relief of a scene, and a numbered box around the points of each object.

    ``flat`` are the points on the sheet, ``height`` is above it in metres; ``edge`` is the side of
    a cell in the units of ``flat``, ``length`` the same in metres.
    """
    low, high = flat.min(axis=0), flat.max(axis=0)
    cells = np.floor((flat - low) / edge + 0.5).astype(np.int64)
    wide, tall = cells.max(axis=0) + 1
    place = cells[:, 1] * wide + cells[:, 0]
    count = np.bincount(place, minlength=wide * tall)
    total = np.bincount(place, height, minlength=wide * tall)
    heights = np.where(count, total / np.maximum(count, 1), np.median(height)).reshape(tall, wide)
    relief = LightSource(315, 45).hillshade(heights, dx=length, dy=length)
    relief[count.reshape(tall, wide) == 0] = np.nan
    size = 9.0 * (high - low) / float((high - low).max())
    figure = Figure(figsize=(max(size[0], 2.0), max(size[1], 2.0)))
    axes = figure.add_axes((0.01, 0.01, 0.98, 0.98))
    extent = (low[0], high[0], low[1], high[1])
    axes.imshow(relief, cmap="gray", vmin=-0.3, vmax=1, origin="lower", extent=extent)
    for number, rows in enumerate(objects):
        first, last = flat[rows].min(axis=0), flat[rows].max(axis=0)
        colour = class_colour(number)
        axes.add_patch(
            Rectangle(tuple(first), *(last - first), fill=False, color=colour, linewidth=2)
        )
        axes.annotate(
            str(number), (first[0], last[1]), (0, 2), textcoords="offset points", weight="bold",
            color="white", bbox={"facecolor": colour, "edgecolor": "none", "pad": 1},
        )  # fmt: skip
    without_frame(axes)
    return figure
