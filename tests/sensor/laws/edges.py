"""A plate before a wall: bands without a match (T4) and the reach of its edges (T5)."""

import numpy as np
from jaxtyping import Float

from qs3.sensor.light import Body
from qs3.sensor.matching import MatchingSettings
from qs3.sensor.rig import Region
from qs3.sensor.view import ViewImages

from .bench import Bench, distances, painted, plate, wall
from .metrics import Row, row

NEAR = 1.0
"""Pixels of disparity within which a match is one of a surface."""
SPILL, BAND = 2.5, 2.0
"""Pixels by which an edge of ``ad-census`` and the empty band beside it may be off. A D415's own
depth ends from 2.2 px outside to 0.4 px inside the edges of a table, a can and a bottle, with bands
of 7.5 and 15 px at steps of 8 and 14.5."""
_ROWS = 96  # of the strips that are measured


def allowed(matching: MatchingSettings) -> float:
    """Pixels by which an edge may be off: half a block of block matching; geometry."""
    return SPILL if matching.method == "ad-census" else matching.block_size / 2


def edge_distances(bench: Bench) -> tuple[float, float]:
    """Distances of plate and wall: 0.6 m and 1 m, or farther in the same ratio.

    The plate is at least 1.2 times as far as the nearest that the sensor measures.
    """
    nearest = distances(bench.sensor, 2)[0]
    near = max(0.6 if bench.sensor.metric else 0.0, 1.2 * nearest)
    return near, near / 0.6


def before_wall(bench: Bench) -> tuple[Body, Body]:
    """A plate, 0.15 of the frame's width to either side of its middle, before a wall."""
    near, far = edge_distances(bench)
    width = 2 * 0.15 * bench.rig.width * near / bench.rig.focal
    sheet = plate((0.0, near), width, 2 * near * bench.rig.height / bench.rig.focal)
    return painted(sheet), painted(wall(far))


def _strip(bench: Bench, left: int, right: int) -> Region:
    rig, rows = bench.rig, min(_ROWS, bench.rig.height)
    left, right = max(0, left), min(rig.width, right)
    return Region(left, (rig.height - rows) // 2, right - left, rows)


def _shoot_edges(bench: Bench) -> tuple[ViewImages, float, float, tuple[int, int]]:
    near, far = (float(bench.rig.disparity(z)) for z in edge_distances(bench))
    block, middle = bench.sensor.matching.block_size, bench.rig.width / 2
    reach = int(0.15 * bench.rig.width + (near - far) + 4 * block)
    view = bench.shoot(before_wall(bench), _strip(bench, int(middle - reach), int(middle + reach)))
    front = np.flatnonzero(view.mask.any(axis=0))
    return view, near, far, (int(front[0]), int(front[-1]))


def bands(bench: Bench) -> list[Row]:
    """T4: the band at the left border of a wall and the shadow left of a plate.

    Expected are f·b/z ± 1 px and f·b·(1/z₁ − 1/z₂) ± half a block: geometry of a stereo pair;
    with ``ad-census`` the shadow ± 2 px, as a D415 has it.
    """
    matching, rows = bench.sensor.matching, []
    if matching.left_band == "physical":
        for index, z in enumerate(distances(bench.sensor, 2)):
            expected = float(bench.rig.disparity(z))
            region = _strip(bench, 0, int(expected) + 4 * matching.block_size)
            view = bench.shoot([painted(wall(z))], region, index)
            rows.append(band_row(view.disparity, expected, f"at {z:.2f} m"))
    view, near, far, (first, _) = _shoot_edges(bench)
    off = BAND if matching.method == "ad-census" else matching.block_size / 2
    return [*rows, shadow_row(view.disparity, first, near, far, off)]


def band_row(disparity: Float[np.ndarray, "h w"], expected: float, where: str = "") -> Row:
    """Judge the band without a match at the left border of a facing wall, ``expected`` px wide."""
    valid = np.isfinite(disparity)
    first = np.where(valid.any(axis=1), valid.argmax(axis=1), disparity.shape[1])
    what = f"left band {where}".strip()
    return row(what, np.median(first), expected - 1, expected + 1)


def shadow_row(
    disparity: Float[np.ndarray, "h w"], first: int, near: float, far: float, off: float
) -> Row:
    """Judge the shadow on a wall (disparity ``far``) left of a plate (``near``, from ``first``).

    It reaches left to the nearest column in which at least half of the rows have the wall's
    disparity; matches of the plate's fattened edge lie within it. Its width may be ``off`` px off.
    """
    behind = (np.abs(disparity[:, :first] - far) < NEAR).mean(axis=0) >= 0.5
    width = float(np.argmax(behind[::-1])) if behind.any() else np.nan
    least, most = max(0.0, near - far - off), near - far + off
    return row("shadow left of an edge", width, least, most)


def edges(bench: Bench) -> list[Row]:
    """T5: the left and right edge of a plate before a wall.

    It looks wider than it is by at most half a block at either edge: geometry of block matching.
    With ``ad-census`` by at most ``SPILL``.
    """
    matching = bench.sensor.matching
    view, near, _, sides = _shoot_edges(bench)
    return edge_rows(view.disparity, sides, near, 2 * matching.block_size, allowed(matching))


def edge_rows(
    disparity: Float[np.ndarray, "h w"],
    sides: tuple[int, int],
    near: float,
    reach: int,
    most: float,
) -> list[Row]:
    """Judge how far a plate of disparity ``near`` reaches beyond its first and last column.

    Its depth is looked for within ``reach`` px of either edge, which may be ``most`` px off.
    """
    wide = ((0, 0), (reach, reach))
    padded = np.pad(disparity.astype(np.float64), wide, constant_values=np.nan)
    left = padded[:, sides[0] : sides[0] + 2 * reach][:, ::-1]
    right = padded[:, sides[1] + 1 : sides[1] + 1 + 2 * reach]
    grown = {"left": fattening(left, near, reach), "right": fattening(right, near, reach)}
    return [
        row(f"fattening of the {side} edge", np.median(pixels), -most, most)
        for side, pixels in grown.items()
    ]


def fattening(part: Float[np.ndarray, "h w"], near: float, edge: int) -> Float[np.ndarray, "h"]:
    """Return the pixels by which the plate, at the left, reaches beyond its edge in each row.

    Its edge is column ``edge`` − 1. Holes within do not end it, the last column of its depth does;
    negative if it is short.

    Example:
        >>> fattening(np.array([[9.0, 9.0, 9.0, 2.0], [9.0, 2.0, 2.0, 2.0]]), 9.0, 2).tolist()
        [1.0, -1.0]
    """
    plated = np.abs(part - near) < NEAR
    last = part.shape[1] - 1 - plated[:, ::-1].argmax(axis=1)
    return np.where(plated.any(axis=1), last + 1.0 - edge, -float(edge))
