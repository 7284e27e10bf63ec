"""A plate before a wall: bands without a match (T4) and what happens at the edges (T5)."""

from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from jaxtyping import Bool, Float, Shaped

from qs3.sensor.matching import MatchingSettings
from qs3.sensor.realism.bench import Bench, distances, middle, painted, plate, wall
from qs3.sensor.realism.rows import Judged, Row, row
from qs3.sensor.render import Body
from qs3.sensor.rig import Region, StereoRig
from qs3.sensor.scene import rectangle
from qs3.sensor.view import ViewImages

if TYPE_CHECKING:
    import trimesh

NEAR = 1.0
"""Pixels of disparity within which a match is one of a surface."""
SPILL, FARTHEST, BAND = 2.5, 5.0, 2.0
"""What ``ad-census`` may have in pixels: the median of an edge's spill, its 90th percentile, and
how much the empty band beside it differs from the step in disparity. A D415's own depth ends from
2.2 px outside to 0.4 px inside the edges of a table, a can and a bottle, with bands of 7.5 and
15 px at steps of 8 and 14.5."""
STEPS, BARS = (5, 10, 25), (3, 5, 8, 12)
"""Steps of disparity at which spill is measured, and widths of bars; in pixels."""
EDGES = (("box", "left"), ("box", "right"), ("box", "top"), ("can", "left"), ("can", "right"),
         ("table", "top"))  # fmt: skip
_ROWS = 96  # of the strips that are measured
_REACH = 20  # pixels beyond an edge in which the object's depth is its spill


def allowed(matching: MatchingSettings) -> float:
    """Pixels by which an edge may be off: half a block of block matching; geometry."""
    return SPILL if matching.method == "ad-census" else matching.block_size / 2


def edge_distances(bench: Bench) -> tuple[float, float]:
    """Where plate and wall stand: 0.6 m and 1 m, or farther in the same ratio.

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
    """Columns ``left`` to ``right`` − 1 of a few rows about the middle of the frame."""
    rig, rows = bench.rig, min(_ROWS, bench.rig.height)
    left, right = max(0, left), min(rig.width, right)
    return Region(left, (rig.height - rows) // 2, right - left, rows)


def _shoot_edges(bench: Bench) -> tuple[ViewImages, float, float, tuple[int, int]]:
    """A plate before a wall: both disparities, the plate's first and last column."""
    near, far = (float(bench.rig.disparity(z)) for z in edge_distances(bench))
    block, middle = bench.sensor.matching.block_size, bench.rig.width / 2
    reach = int(0.15 * bench.rig.width + (near - far) + 4 * block)
    view = bench.shoot(before_wall(bench), _strip(bench, int(middle - reach), int(middle + reach)))
    front = np.flatnonzero(view.mask.any(axis=0))
    return view, near, far, (int(front[0]), int(front[-1]))


# T4


def bands(bench: Bench) -> Judged:
    """T4: the band at the left border of a wall and the shadow left of a plate.

    Expected are f·b/z ± 1 px and f·b·(1/z₁ − 1/z₂) ± half a block: geometry of a stereo pair;
    with ``ad-census`` the shadow ± 2 px, as a D415 has it.
    """
    matching, rows = bench.sensor.matching, []
    if matching.left_band == "physical":
        for index, z in enumerate(distances(bench.sensor, 2 if bench.quick else 4)):
            expected = float(bench.rig.disparity(z))
            region = _strip(bench, 0, int(expected) + 4 * matching.block_size)
            view = bench.shoot([painted(wall(z))], region, index)
            rows += band_rows(view.disparity, expected, f"at {z:.2f} m")
    view, near, far, (first, _) = _shoot_edges(bench)
    off = BAND if matching.method == "ad-census" else matching.block_size / 2
    return rows + shadow_rows(view.disparity, first, near, far, off), {}


def band_rows(disparity: Float[np.ndarray, "h w"], expected: float, where: str = "") -> list[Row]:
    """Judge the band without a match at the left border of a facing wall, ``expected`` px wide."""
    valid = np.isfinite(disparity)
    first = np.where(valid.any(axis=1), valid.argmax(axis=1), disparity.shape[1])
    what = f"left band {where}".strip()
    return [row(what, float(np.median(first)), expected - 1, expected + 1, "px")]


def shadow_rows(
    disparity: Float[np.ndarray, "h w"], first: int, near: float, far: float, off: float
) -> list[Row]:
    """Judge the shadow of a plate on the wall to its left.

    The shadow reaches from the plate's edge to the nearest column in which at least half of the
    rows have the wall's disparity; matches of the plate's fattened edge lie within it.

    Args:
        disparity: Of plate and wall.
        first: The plate's first column.
        near: The plate's disparity.
        far: The wall's disparity.
        off: By how many pixels its width may be off.
    """
    behind = (np.abs(disparity[:, :first] - far) < NEAR).mean(axis=0) >= 0.5
    width = float(np.argmax(behind[::-1])) if behind.any() else float("nan")
    least, most = max(0.0, near - far - off), near - far + off
    inside = disparity[:, max(0, first - round(near - far)) : first]
    return [
        row("shadow left of an edge", width, least, most, "px"),
        row("share of it without a match", np.isnan(inside).mean()),
    ]


# T5


def edges(bench: Bench) -> Judged:
    """T5: the left and right edge of a plate before a wall.

    It looks wider than it is by at most half a block at either edge: geometry of block matching.
    With ``ad-census`` by at most ``SPILL``, and `spills` are measured too.
    """
    matching = bench.sensor.matching
    view, near, far, sides = _shoot_edges(bench)
    rows, data = edge_rows(view.disparity, sides, near, far, matching.block_size, allowed(matching))
    return rows + (spills(bench) if matching.method == "ad-census" else []), data


def edge_rows(
    disparity: Float[np.ndarray, "h w"],
    sides: tuple[int, int],
    near: float,
    far: float,
    block: int,
    most: float,
) -> Judged:
    """Judge how far a plate reaches beyond its true edges.

    Args:
        disparity: Of plate and wall.
        sides: The plate's first and last column.
        near: The plate's disparity.
        far: The wall's disparity.
        block: The matcher's block.
        most: Pixels by which either edge may be off.

    Returns:
        Rows, and the profile over both edges: by pixels from the true edge (outside is positive),
        the share of rows with the plate's depth and with one between plate and wall.
    """
    reach = 2 * block
    wide = ((0, 0), (reach, reach))
    padded = np.pad(disparity.astype(np.float64), wide, constant_values=np.nan)
    outward = {
        "left": padded[:, sides[0] : sides[0] + 2 * reach][:, ::-1],
        "right": padded[:, sides[1] + 1 : sides[1] + 1 + 2 * reach],
    }
    rows = []
    for side, part in outward.items():
        grown = np.median(fattening(part, near, reach))
        rows.append(row(f"fattening of the {side} edge", grown, -most, most, "px"))
    both = np.concatenate(list(outward.values()))
    between = (both > far + NEAR) & (both < near - NEAR)
    around = slice(reach - block, reach + block)
    valid = np.isfinite(both[:, around]).sum()
    flying = between[:, around].sum() / valid if valid else np.nan
    rows.append(row("flying points within a block of the edges", 100 * flying, unit="%"))
    return rows, {
        "offset": np.arange(-reach, reach) + 0.5,
        "near_share": (np.abs(both - near) < NEAR).mean(axis=0),
        "between_share": between.mean(axis=0),
    }


def fattening(part: Float[np.ndarray, "h w"], near: float, edge: int) -> Float[np.ndarray, "h"]:
    """Pixels by which the plate, at the left, reaches beyond column ``edge`` − 1 in each row.

    Holes within it do not end it, the last column of its depth does; negative where it is short.

    Example:
        >>> fattening(np.array([[9.0, 9.0, 9.0, 2.0], [9.0, 2.0, 2.0, 2.0]]), 9.0, 2).tolist()
        [1.0, -1.0]
    """
    plated = np.abs(part - near) < NEAR
    last = part.shape[1] - 1 - plated[:, ::-1].argmax(axis=1)
    return np.where(plated.any(axis=1), last + 1.0 - edge, -float(edge))


def spills(bench: Bench) -> list[Row]:
    """Box, can and table edge before a wall, and thin bars, at ``STEPS`` of disparity.

    Steps that are too near for the sensor are left out.
    """
    rig, rows = bench.rig, []
    z = middle(bench.sensor)
    far, nearest = (float(rig.disparity(d)) for d in (z, distances(bench.sensor, 2)[0]))
    for step in (step for step in STEPS if far + step <= nearest):
        near = float(rig.disparity(1.0)) / (far + step)
        views = {
            name: bench.shoot([painted(mesh), painted(wall(z))], _around(rig, step))
            for name, mesh in _targets(rig, near).items()
        }
        rows += spill_rows(views, far, step)
        if step == STEPS[1]:
            rows += bar_rows(views["bars"], far + step)
    return rows


def _half(rig: StereoRig) -> int:
    """Half the width of box, can and table in pixels."""
    return min(60, rig.height // 8)


def _around(rig: StereoRig, step: int) -> Region:
    """The part of the frame about the targets."""
    half = _half(rig)
    wide, high = min(2 * (half + step + 2 * _REACH), rig.width), min(3 * half, rig.height)
    return Region((rig.width - wide) // 2, (rig.height - high) // 2, wide, high)


def _targets(rig: StereoRig, near: float) -> "dict[str, trimesh.Trimesh]":
    """What stands before the wall, its outline at the distance ``near``.

    Box and can reach down out of the picture, the box from a quarter of its width above the middle;
    the table leans towards the camera from its far edge in the middle, by 45°.
    """
    import trimesh

    pixel, half = near / rig.focal, _half(rig)
    side = half * pixel
    box = trimesh.creation.box(bounds=[[-side, near, -3 * side], [side, near + side, side / 2]])
    can = trimesh.creation.cylinder(side, 6 * side, sections=180)
    can.apply_translation([0.0, near + side**2 / near, 0.0])
    leaning = np.array([0.0, side, side])
    table = rectangle(np.array([0.0, near, 0.0]) - leaning, np.array([side, 0.0, 0.0]), leaning)
    places = np.linspace(-1.0, 1.0, len(BARS)) * side
    widths = zip(places.tolist(), BARS, strict=True)
    bars: Any = trimesh.util.concatenate(
        [plate((place, near), width * pixel, 6 * side) for place, width in widths]
    )
    return {"box": box, "can": can, "table": table, "bars": bars}


def spill_rows(views: Mapping[str, ViewImages], far: float, step: int) -> list[Row]:
    """Judge how far each of ``EDGES`` spills, and the empty band left of box and can."""
    rows, late, bands = [], [], []
    for name, side in EDGES:
        parts = [_outward(image, side) for image in (views[name].disparity, views[name].mask)]
        beyond, empty = spill(parts[0], parts[1], far, step)
        what = f"spill of the {name}'s {side} edge at {step} px"
        rows.append(row(what, float(np.median(beyond)), -SPILL, SPILL, "px"))
        late.append(float(np.percentile(beyond, 90)))
        if side == "left":
            what = f"empty band left of the {name} at {step} px"
            bands.append(row(what, float(np.median(empty)), step - BAND, step + BAND, "px"))
    greatest = row(f"greatest p90 of spill at {step} px", max(late), None, FARTHEST, "px")
    return [*rows, greatest, *bands]


def _outward(image: Shaped[np.ndarray, "h w"], side: str) -> Shaped[np.ndarray, "n m"]:
    """Lines across an edge of a target, from its inside outwards."""
    if side == "top":
        centre, part = image.shape[1] // 2, image.shape[0] // 6
        return image[::-1, centre - part : centre + part].T
    lower = image[image.shape[0] // 2 :]
    return lower[:, ::-1] if side == "left" else lower


def spill(
    disparity: Float[np.ndarray, "n m"], mask: Bool[np.ndarray, "n m"], far: float, step: int
) -> tuple[Float[np.ndarray, "n"], Float[np.ndarray, "n"]]:
    """Pixels by which an object reaches beyond its mask in each line, and how many are empty there.

    Args:
        disparity: Lines from inside of the object to the wall behind it.
        mask: Pixels that show the object.
        far: The wall's disparity.
        step: The object's at its edge less the wall's: nearer than half way is the object.

    Example:
        >>> line = np.array([[9.0, 9.0, 9.0, np.nan, 2.0, 2.0]])
        >>> spill(line, np.array([[True, True, False, False, False, False]]), 2.0, 7)
        (array([1.]), array([1.]))
    """
    place = np.arange(disparity.shape[1])
    edge = _last(mask)[:, None]
    near = (disparity > far + step / 2) & (place < edge + _REACH)
    band = (place >= edge) & (place < edge + step + _REACH)
    return _last(near) - edge[:, 0], (np.isnan(disparity) & band).sum(axis=1).astype(np.float64)


def _last(part: Bool[np.ndarray, "n m"]) -> Float[np.ndarray, "n"]:
    """The column after the last that is true; 0 where none is."""
    last = part.shape[1] - part[:, ::-1].argmax(axis=1)
    return np.where(part.any(axis=1), last, 0).astype(np.float64)


def bar_rows(view: ViewImages, near: float) -> list[Row]:
    """Tell which share of each of ``BARS`` has the bars' disparity."""
    first = np.flatnonzero(np.diff(view.mask.any(axis=0), prepend=False, append=False))
    kept = np.abs(view.disparity - near) < NEAR
    return [
        row(f"share kept of a bar ({width} px)", kept[:, low:high].mean())
        for width, low, high in zip(BARS, first[::2], first[1::2], strict=True)
    ]
