"""Closed solids of which furniture and machine parts are made; lengths in metres, z up."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Literal

import numpy as np
import trimesh
from jaxtyping import Float, Int

from qs3.shapes._dice import Dice

Number = int | float
"""float or int, as arguments are checked at run time in tests."""
Span = tuple[Number, Number]
Point = tuple[Number, Number, Number]


@dataclass(frozen=True)
class Solid:
    """One closed solid."""

    vertices: Float[np.ndarray, "n 3"]
    """Corners, metres."""
    faces: Int[np.ndarray, "m 3"]
    """Corners of each triangle, anticlockwise seen from outside."""

    def move(self, x: Number = 0.0, y: Number = 0.0, z: Number = 0.0) -> "Solid":
        """Return the part shifted."""
        return Solid(self.vertices + np.array([x, y, z], dtype=float), self.faces)

    def turn(
        self, axis: Literal["x", "y", "z"], degrees: Number, about: Point = (0.0, 0.0, 0.0)
    ) -> "Solid":
        """Return the part turned about an axis through ``about``, anticlockwise seen from +axis."""
        c, s = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
        i, j = {"x": (1, 2), "y": (2, 0), "z": (0, 1)}[axis]
        matrix = np.eye(3)
        matrix[i, i] = matrix[j, j] = c
        matrix[i, j], matrix[j, i] = -s, s
        centre = np.array(about, dtype=float)
        return Solid((self.vertices - centre) @ matrix.T + centre, self.faces)


def assemble(parts: Sequence[Solid]) -> trimesh.Trimesh:
    """Put parts into one mesh; each keeps its own vertices."""
    counts = np.cumsum([0] + [len(part.vertices) for part in parts])
    vertices = np.concatenate([part.vertices for part in parts])
    faces = np.concatenate([part.faces + n for part, n in zip(parts, counts, strict=False)])
    return trimesh.Trimesh(vertices=vertices, faces=faces, process=False)


def loft(
    rings: Float[np.ndarray, "r c 3"], cyclic: bool = False, cap: Literal["fan", "zip"] = "fan"
) -> Solid:
    """Solid between successive rings of as many points each, closed at both ends.

    Args:
        rings: Closed curves; a ring may shrink to one point.
        cyclic: Join the last ring to the first instead of capping.
        cap: ``"fan"``: triangles about the ring's centre (star-shaped rings); ``"zip"``: point i
            joined to point c − 1 − i (rings that run along a sheet and back).
    """
    count, size = rings.shape[:2]
    index = np.arange(count * size).reshape(count, size)
    lower = index if cyclic else index[:-1]
    upper = np.roll(index, -1, axis=0) if cyclic else index[1:]
    a, b = lower.ravel(), np.roll(lower, -1, axis=1).ravel()
    d, c = upper.ravel(), np.roll(upper, -1, axis=1).ravel()
    faces = [np.stack([a, b, c], axis=1), np.stack([a, c, d], axis=1)]
    vertices = rings.reshape(-1, 3)
    if not cyclic and cap == "fan":
        vertices = np.concatenate([vertices, rings[0].mean(0)[None], rings[-1].mean(0)[None]])
        for ring, hub, step in ((index[0], count * size, 1), (index[-1], count * size + 1, -1)):
            faces.append(np.stack([np.roll(ring, -step), ring, np.full(size, hub)], axis=1))
    elif not cyclic:
        for ring in (index[0], index[-1][::-1]):
            i = np.arange(size // 2 - 1)
            j = size - 1 - i
            faces.append(np.stack([ring[i + 1], ring[i], ring[j]], axis=1))
            faces.append(np.stack([ring[i + 1], ring[j], ring[j - 1]], axis=1))
    return weld(vertices, np.concatenate(faces))


def weld(vertices: Float[np.ndarray, "n 3"], faces: Int[np.ndarray, "m 3"]) -> Solid:
    """Weld points that coincide, drop the faces that vanish with them, turn the rest outward."""
    _, first, weld = np.unique(
        np.round(vertices, 7), axis=0, return_index=True, return_inverse=True
    )
    vertices, faces = vertices[first], weld.reshape(-1)[faces]
    distinct = (
        (faces[:, 0] != faces[:, 1]) & (faces[:, 1] != faces[:, 2]) & (faces[:, 2] != faces[:, 0])
    )
    faces = faces[distinct]
    a, b, c = (vertices[faces[:, i]] for i in range(3))
    inside_out = (a * np.cross(b, c)).sum() < 0
    return Solid(vertices, faces[:, ::-1] if inside_out else faces)


def outline(
    width: Number, depth: Number, sides: int = 24, exponent: Number = 2.0, phase: Number = 0.0
) -> Float[np.ndarray, "n 2"]:
    """Superellipse |2x/width|ᵉ + |2y/depth|ᵉ = 1 as a polygon: e = 2 an ellipse, 8 nearly a box."""
    angle = 2 * np.pi * (np.arange(sides) + phase) / sides
    c, s = np.cos(angle), np.sin(angle)
    reach = (np.abs(c) ** exponent + np.abs(s) ** exponent) ** (-1 / exponent)
    return np.stack([width / 2 * reach * c, depth / 2 * reach * s], axis=1)


def at_height(polygon: Float[np.ndarray, "n 2"], z: Number) -> Float[np.ndarray, "n 3"]:
    """Lay a polygon of the ground plane at height ``z``."""
    return np.column_stack([polygon, np.full(len(polygon), z)])


def around(middle: Number, half: Number) -> Span:
    """Reach ``half`` to either side of ``middle``."""
    return (middle - half, middle + half)


def centred(length: Number) -> Span:
    """Span of this length about 0."""
    return (-length / 2, length / 2)


def within(span: Span, by: Number) -> Span:
    """Take ``by`` off both ends of a span; a negative one makes it longer."""
    return (span[0] + by, span[1] - by)


def split(span: Span, count: int, gap: Number = 0.0) -> list[Span]:
    """Cut a span into equal ones, each shorter by ``gap``."""
    edges = np.linspace(*span, count + 1)
    return [(a + gap / 2, b - gap / 2) for a, b in pairwise(edges)]


def slab(polygon: Float[np.ndarray, "n 2"], z: Span) -> Solid:
    """Upright prism over a polygon that is star-shaped about its mean."""
    return loft(np.stack([at_height(polygon, z[0]), at_height(polygon, z[1])]))


def block(x: Span, y: Span, z: Span) -> Solid:
    """Box along the axes."""
    corners = np.array([(x[0], y[0]), (x[1], y[0]), (x[1], y[1]), (x[0], y[1])], dtype=float)
    return slab(corners, z)


def posts(xs: Iterable[Number], ys: Iterable[Number], half: Number, z: Span) -> list[Solid]:
    """Upright boxes 2 ``half`` wide over every crossing of ``xs`` and ``ys``."""
    return [block(around(x, half), around(y, half), z) for x in xs for y in ys]


def flanks(x: Span, y: Span, z: Span, board: Number) -> list[Solid]:
    """Two upright boards at the ends of ``x``, inside it."""
    return [block(a, y, z) for a in ((x[0], x[0] + board), (x[1] - board, x[1]))]


def frame(
    x: Span, y: Span, z: Span, hole: tuple[Span, Span], run: Span, hair: Number = 0.0
) -> list[Solid]:
    """Four boards around a hole in x and z; those above and below reach over ``run``.

    These two fall short of the heights ``z`` by a ``hair``.
    """
    (left, right), (low, top) = hole
    return [
        block((x[0], left), y, z),
        block((right, x[1]), y, z),
        block(run, y, (z[0] + hair, low)),
        block(run, y, (top, z[1] - hair)),
    ]


def frustum(half: Span, middle: Number, ends: Sequence[Span], squeeze: Number = 1.0) -> Solid:
    """Tapering box along y; ``half`` is in x and z, ``ends`` are (share of it, y)."""
    corners = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * half
    rings = [
        np.stack([s * corners[:, 0], np.full(4, y), middle + s * corners[:, 1] * squeeze], axis=1)
        for s, y in ends
    ]
    return loft(np.stack(rings))


def cushion(
    dice: Dice,
    x: Span,
    y: Span,
    z: Span,
    radius: Number,
    crown: Number = 0.0,
    steps: int | None = None,
) -> Solid:
    """Box with edges rounded to ``radius`` and a top swollen by ``crown``; 1 step is a bevel."""
    steps = dice.steps if steps is None else steps
    low, high = np.array([x[0], y[0], z[0]], float), np.array([x[1], y[1], z[1]], float)
    half = (high - low) / 2
    r = min(radius, 0.98 * half.min())
    quarter = np.linspace(0, np.pi / 2, steps + 1)
    turn = np.concatenate([quarter + i * np.pi / 2 for i in range(4)])
    corner = np.repeat([(1, 1), (-1, 1), (-1, -1), (1, -1)], steps + 1, axis=0)
    rings = []
    for side, heights in ((-1, quarter - np.pi / 2), (1, quarter)):
        for height in heights:
            flat = corner * (half[:2] - r) + r * np.cos(height) * np.stack(
                [np.cos(turn), np.sin(turn)], axis=1
            )
            rings.append(at_height(flat, side * (half[2] - r) + r * np.sin(height)))
    if crown:
        top = rings[-1]
        for shrink, rise in ((0.55, 0.75), (0.05, 1.0)):
            rings.append(top * [shrink, shrink, 1.0] + [0.0, 0.0, crown * rise])
    return loft(np.stack(rings) + (low + high) / 2)


def pillow(x: Span, y: Span, z: Span) -> Solid:
    """Soft pillow: thick in the middle, thin at the rim."""
    u = np.linspace(-1, 1, 9)
    a, b = np.meshgrid(u, u, indexing="ij")
    bulge = 0.06 + 0.94 * np.sqrt(np.clip((1 - a**4) * (1 - b**4), 0, 1))
    pinch = 1 - 0.06 * (a * b) ** 2
    sheets = [np.stack([a * pinch, b * pinch, s * bulge], axis=2) for s in (1, -1)]
    rings = np.concatenate([sheets[0], sheets[1][:, ::-1]], axis=1)
    half = np.array([x[1] - x[0], y[1] - y[0], z[1] - z[0]]) / 2
    middle = np.array([x[0] + x[1], y[0] + y[1], z[0] + z[1]]) / 2
    return loft(rings * half + middle, cap="zip")


def lathe(
    profile: Sequence[Span],
    sides: int = 16,
    x: Number = 0.0,
    y: Number = 0.0,
    cyclic: bool = False,
) -> Solid:
    """Turn a profile of (radius, z) about the vertical through (x, y).

    A vessel's profile runs up the outside and down the inside to radius 0, or back to its start if
    ``cyclic``.
    """
    rings = [at_height(outline(2 * r, 2 * r, sides, phase=0.5), z) for r, z in profile]
    return loft(np.stack(rings) + np.array([x, y, 0.0]), cyclic)


def ball(radius: Number, centre: Point, sides: int = 12, squash: Number = 1.0) -> Solid:
    """Sphere, or with ``squash`` ≠ 1 one whose height is scaled."""
    angle = np.linspace(-np.pi / 2, np.pi / 2, max(4, sides // 2 + 1))
    profile = [
        (float(radius * np.cos(a)), float(centre[2] + squash * radius * np.sin(a))) for a in angle
    ]
    return lathe(profile, sides, centre[0], centre[1])


def tube(
    path: Sequence[Point] | Float[np.ndarray, "n 3"],
    radius: Number | Sequence[Number],
    sides: int = 8,
    closed: bool = False,
) -> Solid:
    """Round bar along a path, its ring of ``sides`` corners carried along without twist."""
    points = np.asarray(path, dtype=float)
    if closed:
        ahead = np.roll(points, -1, axis=0) - np.roll(points, 1, axis=0)
    else:
        ahead = np.gradient(points, axis=0)
    ahead = ahead / np.linalg.norm(ahead, axis=1, keepdims=True)
    hint = np.eye(3)[np.argmin(np.abs(ahead[0]))]
    side = np.cross(ahead[0], hint)
    circle = outline(2.0, 2.0, sides, phase=0.5)
    radii = np.broadcast_to(np.asarray(radius, dtype=float), len(points))
    rings = []
    for point, forward, r in zip(points, ahead, radii, strict=True):
        side = side - (side @ forward) * forward
        side = side / np.linalg.norm(side)
        rings.append(point + r * (circle @ np.stack([side, np.cross(forward, side)])))
    return loft(np.stack(rings), cyclic=closed)


def beam(start: Point, end: Point, width: Number, depth: Number, taper: Number = 1.0) -> Solid:
    """Straight bar of rectangular section: ``width`` along x if possible, ``depth`` across.

    An upright beam has level ends, so that a splayed leg stands flat on the floor.
    """
    a, b = np.array(start, float), np.array(end, float)
    ahead = (b - a) / np.linalg.norm(b - a)
    if abs(ahead[2]) > 0.5:
        u, v = np.eye(3)[0], np.eye(3)[1]
    else:
        u = np.cross(ahead, np.eye(3)[2])
        u = u / np.linalg.norm(u)
        v = np.cross(u, ahead)
    square = np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)]) * [width / 2, depth / 2]
    frame = np.stack([u, v])
    return loft(np.stack([a + square @ frame, b + taper * (square @ frame)]))


def sheet(grid: Float[np.ndarray, "r c 3"], thickness: Number) -> Solid:
    """Solid of even thickness about a curved surface given as a grid of points."""
    normal = np.cross(np.gradient(grid, axis=0), np.gradient(grid, axis=1))
    length = np.linalg.norm(normal, axis=2, keepdims=True)
    normal = normal / np.maximum(length, 1e-12) * thickness / 2
    return loft(np.concatenate([grid + normal, (grid - normal)[:, ::-1]], axis=1), cap="zip")


def curved_wall(plan: Float[np.ndarray, "n 2"], z: Span, thickness: Number) -> Solid:
    """Upright wall of even thickness along a curve of the ground plane."""
    rows = [at_height(plan, height) for height in np.linspace(*z, 3)]
    return sheet(np.stack(rows, axis=1), thickness)


def ribbon(
    path: Float[np.ndarray, "n 3"], across: Float[np.ndarray, "#n 3"], thickness: Number
) -> Solid:
    """Strip along ``path`` that reaches ``across`` to either side of it."""
    return sheet(np.stack([path - across, path, path + across], axis=1), thickness)


def bend(corners: Sequence[Point], radius: Number, steps: int = 4) -> Float[np.ndarray, "n 3"]:
    """Polyline with its inner corners rounded, as a pipe is bent."""
    points = np.asarray(corners, dtype=float)
    path = [points[0]]
    for before, corner, after in zip(points[:-2], points[1:-1], points[2:], strict=True):
        arms = [before - corner, after - corner]
        lengths = [float(np.linalg.norm(arm)) for arm in arms]
        ends = [
            corner + arm / length * min(radius, 0.45 * length)
            for arm, length in zip(arms, lengths, strict=True)
        ]
        for t in np.linspace(0, 1, steps + 1):
            path.append((1 - t) ** 2 * ends[0] + 2 * t * (1 - t) * corner + t**2 * ends[1])
    return np.stack([*path, points[-1]])
