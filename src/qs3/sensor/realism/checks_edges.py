"""A plate before a wall: bands without a match (T4) and what happens at the edges (T5)."""

from typing import Any

import numpy as np
from jaxtyping import Float

from qs3.sensor.realism.checks_wall import Plain, distances
from qs3.sensor.realism.results import Row, result, row
from qs3.sensor.realism.stage import Shot, Stage, painted, plate, wall
from qs3.sensor.render import Body
from qs3.sensor.rig import Region

_ROWS = 96  # of the strips that are measured
_NEAR = 1.0  # pixels of disparity within which a match is one of a surface


def edge_distances(stage: Stage) -> tuple[float, float]:
    """Where plate and wall stand: 0.6 m and 1 m, or farther in the same ratio.

    The plate is at least 1.2 times as far as the nearest that the sensor measures.
    """
    nearest = distances(stage.sensor, 2)[0]
    near = max(0.6 if stage.sensor.metric else 0.0, 1.2 * nearest)
    return near, near / 0.6


def strip(stage: Stage, left: int, right: int) -> Region:
    """Columns ``left`` to ``right`` − 1 of a few rows about the middle of the frame."""
    rig, rows = stage.rig, min(_ROWS, stage.rig.height)
    left, right = max(0, left), min(rig.width, right)
    return Region(left, (rig.height - rows) // 2, right - left, rows)


def before_wall(stage: Stage, front: Body | None = None, half: float = 0.15) -> tuple[Body, Body]:
    """A plate, ``half`` of the frame's width to either side of its middle, before a wall."""
    near, far = edge_distances(stage)
    width = 2 * half * stage.rig.width * near / stage.rig.focal
    sheet = plate((0.0, near), width, 2 * near * stage.rig.height / stage.rig.focal)
    return front or painted(sheet), painted(wall(far))


def shoot_edges(stage: Stage, seed: int) -> tuple[Shot, float, float]:
    """Photograph a plate before a wall: the shot, and the disparities of the two."""
    near, far = edge_distances(stage)
    close, distant = float(stage.rig.disparity(near)), float(stage.rig.disparity(far))
    block, middle = stage.sensor.matching.block_size, stage.rig.width / 2
    reach = int(0.15 * stage.rig.width + (close - distant) + 4 * block)
    region = strip(stage, int(middle - reach), int(middle + reach))
    return stage.shoot(before_wall(stage), region, seed), close, distant


# T4


def bands(stage: Stage, seed: int, quick: bool) -> Plain:
    """T4: the band at the left border of a wall and the shadow left of a plate."""
    matching = stage.sensor.matching
    band = []
    if matching.left_band == "physical":
        for index, z in enumerate(distances(stage.sensor, 2 if quick else 4)):
            region = strip(stage, 0, int(stage.rig.disparity(z)) + 4 * matching.block_size)
            shot = stage.shoot([painted(wall(z))], region, seed + index)
            band += band_rows(shot.disparity, float(stage.rig.disparity(z)), f"at {z:.2f} m")
    shot, near, far = shoot_edges(stage, seed)
    first = int(np.flatnonzero((shot.body == 0).any(axis=0))[0])
    return result("T4", band + shadow_rows(shot.disparity, first, near, far, matching.block_size))


def band_rows(disparity: Float[np.ndarray, "h w"], expected: float, where: str = "") -> list[Row]:
    """Judge the band that has no match at the left border of a facing wall.

    Args:
        disparity: From the frame's first column on.
        expected: Its width in pixels.
        where: Added to the row's name.
    """
    valid = np.isfinite(disparity)
    first = np.where(valid.any(axis=1), valid.argmax(axis=1), disparity.shape[1])
    what = f"left band {where}".strip()
    return [row(what, float(np.median(first)), expected - 1, expected + 1, "px")]


def shadow_rows(
    disparity: Float[np.ndarray, "h w"], first: int, near: float, far: float, block: int
) -> list[Row]:
    """Judge the shadow of a plate on the wall to its left.

    The shadow reaches from the plate's edge to the nearest column in which at least half of the
    rows have the wall's disparity; matches of the plate's fattened edge lie within it.

    Args:
        disparity: Of plate and wall.
        first: The plate's first column.
        near: The plate's disparity.
        far: The wall's disparity.
        block: The matcher's block.
    """
    behind = (np.abs(disparity[:, :first] - far) < _NEAR).mean(axis=0) >= 0.5
    width = float(np.argmax(behind[::-1])) if behind.any() else float("nan")
    shadow = near - far
    inside = disparity[:, max(0, first - round(shadow)) : first]
    return [
        row(
            "shadow left of an edge",
            width,
            max(0.0, shadow - block / 2),
            shadow + block / 2,
            "px",
        ),
        row("share of it without a match", np.isnan(inside).mean()),
    ]


# T5


def edges(stage: Stage, seed: int, quick: bool) -> Plain:
    """T5: the left and right edge of a plate before a wall."""
    shot, near, far = shoot_edges(stage, seed)
    front = np.flatnonzero((shot.body == 0).any(axis=0))
    sides = int(front[0]), int(front[-1])
    return result(
        "T5", *edge_rows(shot.disparity, sides, near, far, stage.sensor.matching.block_size)
    )


def edge_rows(
    disparity: Float[np.ndarray, "h w"],
    sides: tuple[int, int],
    near: float,
    far: float,
    block: int,
) -> tuple[list[Row], dict[str, Any]]:
    """Judge how far a plate reaches beyond its true edges.

    Args:
        disparity: Of plate and wall.
        sides: The plate's first and last column.
        near: The plate's disparity.
        far: The wall's disparity.
        block: The matcher's block.

    Returns:
        Rows, and the profile over both edges: by pixels from the true edge (outside is positive),
        the share of rows with the plate's depth and with one between plate and wall.
    """
    reach = 2 * block
    outward = {
        "left": _window(disparity, sides[0] - reach, sides[0] + reach)[:, ::-1],
        "right": _window(disparity, sides[1] + 1 - reach, sides[1] + 1 + reach),
    }
    rows = []
    for side, part in outward.items():
        grown = np.median(fattening(part, near, reach))
        rows.append(row(f"fattening of the {side} edge", grown, -block / 2, block / 2, "px"))
    both = np.concatenate(list(outward.values()))
    between = (both > far + _NEAR) & (both < near - _NEAR)
    around = slice(reach - block, reach + block)
    valid = np.isfinite(both[:, around]).sum()
    flying = between[:, around].sum() / valid if valid else np.nan
    rows.append(row("flying points within a block of the edges", 100 * flying, unit="%"))
    data: dict[str, Any] = {
        "offset": np.arange(-reach, reach) + 0.5,
        "near_share": (np.abs(both - near) < _NEAR).mean(axis=0),
        "between_share": between.mean(axis=0),
    }
    return rows, data


def fattening(part: Float[np.ndarray, "h w"], near: float, edge: int) -> Float[np.ndarray, "h"]:
    """Pixels by which the plate reaches beyond its true edge in each row; negative where short.

    The plate is followed from the inside: holes within it do not end it, the last column of its
    depth does.

    Args:
        part: Disparities, the plate to the left.
        near: The plate's disparity.
        edge: The first column outside the plate.

    Example:
        >>> fattening(np.array([[9.0, 9.0, 9.0, 2.0], [9.0, 2.0, 2.0, 2.0]]), 9.0, 2).tolist()
        [1.0, -1.0]
    """
    plated = np.abs(part - near) < _NEAR
    last = part.shape[1] - 1 - plated[:, ::-1].argmax(axis=1)
    return np.where(plated.any(axis=1), last + 1.0 - edge, -float(edge))


def _window(image: Float[np.ndarray, "h w"], start: int, stop: int) -> Float[np.ndarray, "h w2"]:
    """Columns ``start`` to ``stop`` − 1, NaN where the image has none."""
    made = np.full((image.shape[0], stop - start), np.nan)
    low, high = max(0, start), min(image.shape[1], stop)
    made[:, low - start : high - start] = image[:, low:high]
    return made
