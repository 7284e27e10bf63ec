"""From coarse poses to the best one: alignment with visible points, made again as it moves."""

import functools
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int

from qs3.geometry import length_of
from qs3.parts.align import HELD, align, columns_of, flat_of, placed, settle, weigh
from qs3.parts.field import misses
from qs3.parts.scan import Scan
from qs3.parts.score import DEEP, Score, score
from qs3.parts.search import any_poses, best_poses, choose, table_poses
from qs3.parts.views import LOOKED, Part
from qs3.parts.visible import VIEWS, directions, visible
from qs3.points.compiled import compiled

_COARSE, _KEPT = 24, 10
"""Poses of each kind of start after the search, and poses that may be refined."""
_FIRST, _NEXT, _LAST = (60, LOOKED, 5), (140, 240, 6), (300, 600, 6)
"""Points of the scan, visible points, and steps of the first alignment and of each refinement."""
_SIGMA = 0.10, 0.05, 0.03
"""Widths of the robust kernel, in diameters of the scan: at the start and after each stage."""
_SAME = 1 + 2 * np.cos(np.radians(6))
"""Trace of the turn between two poses that count as one."""


@dataclass(frozen=True)
class Start:
    """A pose to refine."""

    turn: Float[np.ndarray, "3 3"]
    shift: Float[np.ndarray, "3"]
    """From the part to the scan's centre."""
    eye: Float[np.ndarray, "3"]
    """The camera, from the scan's centre."""
    down: Float[np.ndarray, "3"] | None
    """Unit vector of the part that points down on a table; None for any pose."""
    cost: float
    begun: bool = False
    """Whether the first stage of the refinement is done."""


@dataclass(frozen=True)
class Found:
    """A refined pose."""

    turn: Float[np.ndarray, "3 3"]
    shift: Float[np.ndarray, "3"]
    eye: Float[np.ndarray, "3"]
    score: Score
    prior: float
    """Logarithm of how well the pose suits the table; 0 without one."""


def first_poses(scan: Scan, part: Part, table: float | None) -> list[Start]:
    """Return poses after the coarse search and a first alignment, best first.

    ``table`` is the height of the table from the scan's centre, or None.
    """
    starts: list[Start] = []
    cut = cut_of(scan, table)
    for sight in scan.sights:
        if table is not None and scan.eye is None and sight[2] < 0:
            continue  # no camera looks through the table; a known one may stand below the centre
        if table is not None and len(part.resting):
            rotations, views, heights = table_poses(part, sight, table)
            starts += _starts(scan, part, sight, rotations, views, cut, heights)
        starts += _starts(scan, part, sight, *any_poses(sight), cut)
    costs = np.array([start.cost for start in starts])
    chosen = choose(costs, np.stack([start.turn for start in starts]), _KEPT, _SAME)
    return [starts[k] for k in chosen]


def _starts(
    scan: Scan,
    part: Part,
    sight: np.ndarray,
    rotations: np.ndarray,
    views: np.ndarray,
    cut: float,
    heights: np.ndarray | None = None,
) -> list[Start]:
    turns, shifts, views = best_poses(scan, part, rotations, views, sight, _COARSE, heights, cut)
    eye = sight * part.away if scan.eye is None else scan.eye
    downs = [None] * len(turns) if heights is None else [-turn[2] for turn in turns]
    few, width = min(_FIRST[0], len(scan.normals)), scan.diameter
    found = _align_views(
        scan.points[:few], scan.normals[:few], part.points, part.normals, part.seen[:, :LOOKED],
        views, part.gaps[views], turns, shifts, cut, _FIRST[2], _SIGMA[0] * width,
        _SIGMA[1] * width, scan.gap(few), (0.03 * width) ** 2, eye / length_of(eye), DEEP, True,
    )  # fmt: skip
    return [Start(turn, shift, eye, down, cost)
            for turn, shift, cost, down in zip(*found, downs, strict=True)]  # fmt: skip


@compiled
def _align_views(
    scan, scan_normals, points, normals, seen, views, gaps, turns, shifts, cut,
    steps, wide, narrow, scan_gap, across, sight, deep, judged,
):  # fmt: skip
    """Return turns, shifts and costs of poses, each aligned by its view; see `align`."""
    turned, shifted, costs = np.empty_like(turns), np.empty_like(shifts), np.empty(len(turns))
    fixed = placed(columns_of(scan, scan_normals), np.eye(3), np.zeros(3), sight, deep)
    flat = flat_of(fixed)
    for k in range(len(turns)):
        rows = above(points, seen[views[k]], turns[k, 2], shifts[k, 2], cut)
        turn, shift, costs[k] = settle(
            fixed, flat, columns_of(points[rows], normals[rows]), turns[k], shifts[k], steps, wide,
            narrow, gaps[k], scan_gap, across, 0.0, 0.0, np.zeros(3), sight, deep, judged,
        )  # fmt: skip
        for i in range(3):  # slices that are assigned to take seconds to compile
            shifted[k, i] = shift[i]
            for j in range(3):
                turned[k, i, j] = turn[i, j]
    return turned, shifted, costs


def refine(
    scan: Scan, part: Part, start: Start, table: float | None, noise: float, near: bool = False
) -> Found:
    """Align a pose with what the camera sees of the part from there, and score it.

    A pose that is ``near`` takes the last of the two stages alone, and keeps the camera of its
    start.
    """
    if not near and not start.begun:
        start = begin(scan, part, start, table)
    last = max(3 * noise / scan.diameter, 0.012)
    start = _stage(scan, part, start, table, _LAST, (_SIGMA[2], last), near)
    turn, shift, eye, cut = start.turn, start.shift, start.eye, cut_of(scan, table)
    if table is not None:
        shift[2] += max(0.0, table - _SUNK - lowest(part, turn, shift))
    if scan.eye is None and not near:
        eye = _eye(scan, part, turn, shift, eye, table is not None)
    rows, gap = _shown(part, turn, shift, eye, _LAST[1], cut)
    few = min(_LAST[0], len(scan.normals))
    agreed = score(scan, few, part.points[rows], part.normals[rows], gap, turn, shift, eye,
                   noise)  # fmt: skip
    prior = 0.0
    if table is not None:
        off = (lowest(part, turn, shift) - table) / _TABLE
        prior = -4.5 * off**2 / (off**2 + 9)
    return Found(turn, shift, eye, agreed, prior)


def begin(scan: Scan, part: Part, start: Start, table: float | None) -> Start:
    """Return a pose after the first stage of `refine`, and what it costs then."""
    return _stage(scan, part, start, table, _NEXT, _SIGMA[1:])


def _stage(
    scan: Scan,
    part: Part,
    start: Start,
    table: float | None,
    stage: tuple[int, int, int],
    widths: tuple[float, ...],
    near: bool = False,
) -> Start:
    turn, shift, eye, down = start.turn, start.shift, start.eye, start.down
    if scan.eye is None and not near:
        eye = _eye(scan, part, turn, shift, eye, table is not None)
    rows, gap = _shown(part, turn, shift, eye, stage[1], cut_of(scan, table))
    rise, held = 0.0, 0.0
    if table is not None:
        low = lowest(part, turn, shift)
        if down is not None or low < table - _SUNK:
            rise, held = table - low, HELD
            down = -turn[2].copy() if down is None else down
    turn, shift, cost = _aligned(scan, part, rows, gap, stage, turn, shift, eye, widths, rise,
                                 held, down, judged=False)  # fmt: skip
    return Start(turn, shift, eye, start.down, cost, begun=True)


_FEWEST = 12
"""Visible points above the cut, at least."""
_TABLE, _CUT = 0.003, 0.015
"""Metres by which the table is uncertain, and up to which points of a part may have been taken for
the table's."""
_SUNK = 0.005
"""Metres by which a pose reaches through the table, at most: it is lifted. Without that, two poses
in five of a camera that smooths (d435) were over a centimetre too low."""


def cut_of(scan: Scan, table: float | None) -> float:
    """Return the height from which on a scan has points, as lower ones went with the table."""
    if table is None:
        return -np.inf
    return min(scan.low, table + _CUT)


def lowest(part: Part, turn: np.ndarray, shift: np.ndarray) -> float:
    """Return the height of the lowest point of a posed part."""
    return float((part.corners @ turn[2]).min() + shift[2])


def _shown(
    part: Part, turn: np.ndarray, shift: np.ndarray, eye: np.ndarray, most: int, cut: float
) -> tuple[np.ndarray, float]:
    """Return points that the camera sees of a posed part, in random order, and their spacing."""
    rows = visible(part.points, part.spacing, turn.T @ (eye - shift), part.middle)
    order = _mixed(len(rows), most)
    rows, gap = rows[order], part.gap(len(rows), len(order))
    return above(part.points, rows, turn[2], float(shift[2]), cut), gap


@functools.lru_cache(maxsize=4096)  # to draw an order takes as long as to look
def _mixed(count: int, most: int) -> Int[np.ndarray, "few"]:
    order = np.random.default_rng(0).permutation(count)[:most].astype(np.int32)
    order.flags.writeable = False  # all calls share it
    return order


@compiled
def above(points, rows, up, height, cut):
    """Return the points that are above the cut, or all if few are."""
    if cut == -np.inf:
        return rows
    kept, count = np.empty_like(rows), 0
    for row in rows:
        x, y, z = points[row, 0], points[row, 1], points[row, 2]
        if x * up[0] + y * up[1] + z * up[2] + height > cut:
            kept[count] = row
            count += 1
    return kept[:count] if count >= _FEWEST else rows


def _eye(
    scan: Scan, part: Part, turn: np.ndarray, shift: np.ndarray, eye: np.ndarray, above: bool
) -> np.ndarray:
    """Return the place of an unknown camera whose view of the posed part the scan fills best.

    It is ``above`` the part if a table is known.
    """
    distance = length_of(eye)
    field = scan.field
    back = _view_costs(part.looks, turn, shift, field.metres, field.low, field.cell,
                       0.1 * scan.diameter)  # fmt: skip
    ways = directions(VIEWS) @ turn.T
    if above:
        back[ways[:, 2] < 0] = np.inf
    views = np.argsort(back, kind="stable")[:6]
    ways = ways[views]
    few, width = min(60, len(scan.normals)), 0.03 * scan.diameter
    costs = _costs_from(
        scan.points[:few], scan.normals[:few], part.points, part.normals,
        part.seen[views, :LOOKED], np.ascontiguousarray(turn), shift, width, part.gaps[views],
        scan.gap(few), ways, DEEP,
    )  # fmt: skip
    return ways[costs.argmin()] * distance


@compiled
def _costs_from(
    scan, scan_normals, points, normals, seen, turn, shift, width, gaps, scan_gap, ways, deep
):
    """Return the cost of a pose by what is seen of it from each way; see `align`."""
    costs, columns = np.empty(len(ways)), columns_of(scan, scan_normals)
    for k in range(len(ways)):
        fixed = placed(columns, np.eye(3), np.zeros(3), ways[k], deep)
        part = columns_of(points[seen[k]], normals[seen[k]])
        posed = placed(part, turn, shift, ways[k], deep)
        costs[k] = weigh(fixed, flat_of(fixed), posed, width, gaps[k], scan_gap, width * width)[4]
    return costs


@compiled
def _view_costs(looks, turn, shift, metres, low, cell, far):
    """Return the sum of the squares of the distances of the points of each view to the scan."""
    count = looks.shape[2]
    costs, squares = np.empty(len(looks)), np.empty(count, np.float32)
    for view in range(len(looks)):
        costs[view] = misses(metres, low, cell, looks[view], count, turn, shift, far, squares)
    return costs


def _aligned(
    scan: Scan,
    part: Part,
    rows: np.ndarray,
    gap: float,
    stage: tuple[int, int, int],
    turn: np.ndarray,
    shift: np.ndarray,
    eye: np.ndarray,
    widths: tuple[float, ...],
    rise: float = 0.0,
    held: float = 0.0,
    down: np.ndarray | None = None,
    judged: bool = True,
) -> tuple[np.ndarray, np.ndarray, float]:
    few = min(stage[0], len(scan.normals))
    across = (0.03 * scan.diameter) ** 2
    return align(
        scan.points[:few], scan.normals[:few], part.points[rows], part.normals[rows],
        np.ascontiguousarray(turn), shift, stage[2], widths[0] * scan.diameter,
        widths[1] * scan.diameter, gap, scan.gap(few), across,
        rise, held, np.zeros(3) if down is None else down, eye / length_of(eye), DEEP, judged,
    )  # fmt: skip
