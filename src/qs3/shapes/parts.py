"""Machine parts of real size, 2 to 12 cm; a seed draws their proportions within ± 5 %."""

from collections.abc import Callable, Sequence

import numpy as np
from jaxtyping import Float
from scipy.spatial import Delaunay

from qs3.shapes._dice import Dice
from qs3.shapes._solids import Number, Solid, lathe, loft, outline, weld

_SIDES = 48
_COMMON, _OWN = 0.045, 0.005
"""Spread of a part's size, and of each of its lengths beside that."""
_STEP = 0.002
"""Longest edge of a contour in metres: shorter than the gaps between contours."""
Contour = tuple[Float[np.ndarray, "_ 2"], Number]
"""A closed polygon, and the height inside it; 0 is a hole."""


def flange(dice: Dice) -> list[Solid]:
    """Disc with a neck, a bore and four bolt holes."""
    d = _drawn(dice, disc=0.086, thick=0.011, neck=0.046, high=0.034, bore=0.030, ring=0.066)
    ring = outline(d["ring"], d["ring"], 4, phase=0.5)
    disc, neck = (_circle(d["disc"], 72), d["thick"]), (_circle(d["neck"]), d["high"])
    holes = [(_circle(0.009, 16, x, y), 0.0) for x, y in ring]
    return [_terrace([disc, neck, (_circle(d["bore"]), 0.0), *holes])]


def bracket(dice: Dice) -> list[Solid]:
    """Angle of two plates, with holes in both, and a rib."""
    d = _drawn(dice, width=0.044, foot=0.062, high=0.052, thick=0.006, hole=0.009)
    thick, rib = d["thick"], 0.7 * min(d["foot"], d["high"])
    foot, back = (
        [(_rectangle(d["width"], long), thick)]
        + [(_circle(d["hole"], 16, x * d["width"], 0.24 * long), 0.0) for x in (-0.28, 0.28)]
        for long in (d["foot"], d["high"])
    )
    triangle = [(np.array([(0.0, 0.0), (rib, 0.0), (0.0, rib)]), thick)]
    edge = thick - d["foot"] / 2
    return [
        _terrace(foot),
        _terrace(back).turn("x", 90).move(y=edge, z=d["high"] / 2 + thick),
        _terrace(triangle).turn("x", 90).turn("z", 90).move(-thick / 2, edge, thick),
    ]


def gear(dice: Dice) -> list[Solid]:
    """Spur gear of 22 teeth with a thin web, a hub and a bore."""
    d = _drawn(dice, tip=0.064, wide=0.014, web=0.006, hub=0.024, high=0.022, bore=0.012)
    turn = np.arange(22)[:, None] * 2 * np.pi / 22 + np.array([-0.105, -0.055, 0.055, 0.105])
    radius = d["tip"] / 2 * np.array([0.87, 1.0, 1.0, 0.87])
    teeth = np.stack([radius * np.cos(turn), radius * np.sin(turn)], axis=2).reshape(-1, 2)
    web, hub = (_circle(0.76 * d["tip"]), d["web"]), (_circle(d["hub"]), d["high"])
    return [_terrace([(teeth, d["wide"]), web, hub, (_circle(d["bore"]), 0.0)])]


def bolt(dice: Dice) -> list[Solid]:
    """Hexagon bolt, on its head."""
    d = _drawn(dice, flats=0.019, head=0.0085, shank=0.0118, length=0.062)
    hexagon = outline(d["flats"] / np.cos(np.pi / 6), d["flats"] / np.cos(np.pi / 6), 6)
    shank = _circle(d["shank"])
    return [_terrace([(hexagon, d["head"]), (shank, d["head"] + d["length"])])]


def elbow(dice: Dice) -> list[Solid]:
    """Pipe that bends by a right angle, with a collar at each end."""
    d = _drawn(dice, pipe=0.032, wall=0.0035, bend=0.034, collar=0.044, sleeve=0.014)
    angle = np.linspace(0, np.pi / 2, 17)
    arc = np.column_stack([d["bend"] * np.cos(angle), 0 * angle, d["bend"] * np.sin(angle)])
    ahead = np.column_stack([-np.sin(angle), 0 * angle, np.cos(angle)])
    start, end = arc[0] - d["sleeve"] * ahead[0], arc[-1] + d["sleeve"] * ahead[-1]
    path = np.stack([start, arc[0], *arc, arc[-1], end])
    ahead = np.stack([ahead[0]] * 2 + [*ahead] + [ahead[-1]] * 2)
    outer = np.array([d["collar"]] * 2 + [d["pipe"]] * len(arc) + [d["collar"]] * 2) / 2
    inner = np.full(len(path), d["pipe"] / 2 - d["wall"])
    aside = np.array([0.0, 1.0, 0.0])
    ring = outline(2.0, 2.0, _SIDES)
    round_trip = zip([*path, *path[::-1]], [*ahead, *ahead[::-1]], [*outer, *inner], strict=True)
    rings = [
        point + radius * (ring @ np.stack([np.cross(aside, forward), aside]))
        for point, forward, radius in round_trip
    ]
    return [loft(np.stack(rings), cyclic=True)]


def housing(dice: Dice) -> list[Solid]:
    """Open box with round corners, two lugs with holes, and a bearing's seat in its floor."""
    d = _drawn(dice, long=0.076, wide=0.054, high=0.038, wall=0.0045, floor=0.005, seat=0.030)
    box = outline(d["long"], d["wide"], 96, exponent=7.0)
    cavity = outline(d["long"] - 2 * d["wall"], d["wide"] - 2 * d["wall"], 96, exponent=7.0)
    lugs = []
    for side in (-1, 1):
        x = side * (d["long"] / 2 + 0.008)
        plate = (_rectangle(0.018, 0.6 * d["wide"], x, 0.0), d["floor"])
        lugs.append(_terrace([plate, (_circle(0.008, 16, x, 0.0), 0.0)]))
    seat = [(_circle(d["seat"]), 3 * d["floor"]), (_circle(0.72 * d["seat"]), 0.0)]
    return [_terrace([(box, d["high"]), (cavity, d["floor"]), *seat]), *lugs]


def bushing(dice: Dice) -> list[Solid]:
    """Sleeve with a rim."""
    d = _drawn(dice, rim=0.042, thick=0.005, body=0.030, high=0.036, bore=0.022)
    thick, high = d["thick"], d["high"]
    rim, body, bore = d["rim"] / 2, d["body"] / 2, d["bore"] / 2
    outside = [(rim, 0.0), (rim, thick), (body, thick), (body, high)]
    return [lathe([*outside, (bore, high), (bore, 0.0)], _SIDES, cyclic=True)]


def lever(dice: Dice) -> list[Solid]:
    """Arm with an eye at one end and a knob at the other."""
    d = _drawn(dice, reach=0.082, eye=0.030, tip=0.018, arm=0.008, high=0.018, knob=0.036)
    near, far, reach = d["eye"] / 2, d["tip"] / 2, d["reach"]
    lean = np.pi / 2 - np.arcsin((near - far) / reach)
    turns = np.linspace(lean, 2 * np.pi - lean, 25), np.linspace(-lean, lean, 17)
    left, right = (np.column_stack([np.cos(turn), np.sin(turn)]) for turn in turns)
    arm = np.concatenate([near * left, far * right + [reach, 0]])
    eye, hole = (_circle(0.88 * d["eye"]), d["high"]), (_circle(0.5 * d["eye"]), 0.0)
    return [_terrace([(arm, d["arm"]), eye, hole, (_circle(0.8 * d["tip"], 24, reach), d["knob"])])]


PARTS: dict[str, Callable[[Dice], list[Solid]]] = {
    part.__name__: part for part in (bolt, bracket, bushing, elbow, flange, gear, housing, lever)
}


def _drawn(dice: Dice, **lengths: Number) -> dict[str, float]:
    size = dice.between(1 - _COMMON, 1 + _COMMON)
    return {name: size * v * dice.between(1 - _OWN, 1 + _OWN) for name, v in lengths.items()}


def _circle(
    diameter: Number, sides: int = _SIDES, x: Number = 0.0, y: Number = 0.0
) -> Float[np.ndarray, "n 2"]:
    return outline(diameter, diameter, sides) + np.array([x, y], dtype=float)


def _rectangle(
    width: Number, depth: Number, x: Number = 0.0, y: Number = 0.0
) -> Float[np.ndarray, "4 2"]:
    return np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * [width / 2, depth / 2] + [x, y]


def _terrace(contours: Sequence[Contour]) -> Solid:
    """Solid on z = 0 with the height of the innermost contour.

    Contours do not touch; one that lies in another comes after it. Every edge between triangles of
    different height gets a wall, so that the solid is closed.
    """
    rings = [_dense(polygon) for polygon, _ in contours]
    plan = Delaunay(np.concatenate(rings))
    corners, middles = plan.points[plan.simplices], plan.points[plan.simplices].mean(axis=1)
    heights = np.zeros(len(middles) + 1)  # the last: outside of the hull, which is neighbour -1
    for ring, (_, height) in zip(rings, contours, strict=True):
        heights[:-1][_inside(ring, middles)] = height
    tops = heights[:-1]
    solid = tops > 0
    faces = [_lift(corners, tops[:, None])[solid], _lift(corners, 0 * tops[:, None])[solid, ::-1]]
    for i in range(3):
        a, b, below = corners[:, i - 2], corners[:, i - 1], heights[plan.neighbors[:, i]]
        wall = tops > below
        ends = [_lift(end, level)[wall] for level in (below, tops) for end in (a, b)]
        faces += [np.stack([ends[k] for k in order], axis=1) for order in ((0, 1, 3), (0, 3, 2))]
    vertices = np.concatenate(faces).reshape(-1, 3)
    return weld(vertices, np.arange(len(vertices)).reshape(-1, 3))


def _lift(points: np.ndarray, z: np.ndarray) -> np.ndarray:
    return np.concatenate([points, np.broadcast_to(z, points.shape[:-1])[..., None]], axis=-1)


def _dense(polygon: np.ndarray) -> np.ndarray:
    ends = np.roll(polygon, -1, axis=0)
    counts = np.ceil(np.linalg.norm(ends - polygon, axis=1) / _STEP).astype(int)
    edges = zip(polygon, ends, counts, strict=True)
    return np.concatenate([np.linspace(a, b, n, endpoint=False) for a, b, n in edges])


def _inside(polygon: np.ndarray, points: np.ndarray) -> np.ndarray:
    a, b, y = polygon, np.roll(polygon, -1, axis=0), points[:, None, 1]
    spans = (a[:, 1] > y) != (b[:, 1] > y)
    rise = np.where(a[:, 1] == b[:, 1], 1.0, b[:, 1] - a[:, 1])
    crossing = a[:, 0] + (y - a[:, 1]) * (b[:, 0] - a[:, 0]) / rise
    return (spans & (points[:, None, 0] < crossing)).sum(axis=1) % 2 == 1
