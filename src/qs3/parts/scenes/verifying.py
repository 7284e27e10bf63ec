"""A posed part against the whole depth picture: what agrees, what is hidden, and what is refuted.

A visible point of the part agrees if a measured point lies on its tangent plane beside it. It is
hidden if something nearer was measured there, and refuted if the camera looked through it, or if it
would lie under the table.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int32

from qs3.geometry import invert_rigid
from qs3.parts.scenes.picture import Picture
from qs3.parts.views import Part
from qs3.parts.visible import WIDE, visible
from qs3.points.compiled import compiled

_BEYOND = 4
"""Pixels from inside the outline to outside, at least."""
_REACH = 1.5
"""Blurs of the camera from inside the outline to outside: there the ramp of an edge has ended."""
_SLANTED = 0.25
"""Cosine of the line of sight to a surface from which on a camera measures it well."""
SHARP = 1.7
"""Pixels of blur of the scenes that the limits of `bent` were found on."""
_PATCHES = 5
"""Patches along a part, of 3 pixels at least."""
_SUNK, _AFLOAT, _OFF = 0.3, 0.1, 0.004
"""Share of its area that a part costs that lies under the table, or over it, by so many metres."""


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """A part in a pose, and what the picture says about it; areas are in pixels."""

    part: Part
    pose: Float[np.ndarray, "4 4"]
    """Camera from part."""
    pixels: Int32[np.ndarray, "k"]
    """Flat indices of the pixels that lie on the part."""
    gains: Float[np.ndarray, "k"]
    """1 for a pixel on the surface down to 0 at the tolerance."""
    agreed: float
    refuted: float
    hidden: float
    unknown: float
    beyond: float
    """Areas of the visible surface: measured there, seen through, behind something, without depth,
    and beyond the picture."""
    continued: float
    """Share of the outline beyond which what was measured goes on in the same surface."""
    outline: int
    """Pixels of the outline, counted once for each of four sides."""
    joined: Int32[np.ndarray, "j"]
    """Flat indices of pixels beyond the outline that are measured, off the table and no jump away:
    each is another part that touches this one, or this one is seen into something larger."""
    errors: Float[np.ndarray, "k"]
    """Metres by which the pixels are off the surface, along its normal."""
    low: float = 0.0
    """Metres from the table up to the lowest point of the part; 0 without a table."""
    rival: float = 0.0
    """Value of the best other explanation of these pixels, by that of this one."""

    @property
    def middle(self) -> Float[np.ndarray, "3"]:
        """Middle of the part, in the axes of the camera."""
        return self.pose[:3, :3] @ self.part.middle + self.pose[:3, 3]

    @property
    def area(self) -> float:
        """Visible surface within the picture, in pixels, as if nothing stood before it."""
        return self.agreed + self.refuted + self.hidden + self.unknown

    @property
    def agreement(self) -> float:
        """Share of the surface, of what nothing hides, that is confirmed, less what is refuted."""
        shown = self.agreed + self.refuted + 0.5 * self.unknown
        return max(0.0, (self.agreed - self.refuted) / max(shown, 1e-9))

    @property
    def residual(self) -> float:
        """Metres: root mean square of the errors."""
        return float(np.sqrt(np.mean(self.errors**2))) if len(self.errors) else float("inf")

    @property
    def value(self) -> float:
        """Pixels that it explains well, less what speaks against it.

        A part lies on the table, with a point at least, or on another part.
        """
        against = self.refuted + 0.25 * self.unknown + 0.1 * self.hidden
        off = (_SUNK if self.low < 0 else _AFLOAT) * min(abs(self.low) / _OFF, 1.0) ** 2
        return float(self.gains.sum()) - against - (0.5 * self.continued + off) * self.area


def verify(picture: Picture, part: Part, pose: Float[np.ndarray, "4 4"]) -> Hypothesis:
    """Hold a posed part against a picture."""
    eye = invert_rigid(pose)[:3, 3]
    rows = visible(part.points, part.spacing, eye, part.middle)
    away = max(float(np.linalg.norm(pose[:3, :3] @ part.middle + pose[:3, 3])), 1e-6)
    cell = WIDE * part.spacing
    camera = picture.camera
    tolerance = picture.tolerance(away)
    areas, pixels, errors, continued, outline, joined = _compare(
        part.points[rows], part.normals[rows], pose[:3, :3].copy(), pose[:3, 3].copy(),
        picture.depth, picture.cluster, camera.fx, camera.fy, camera.cx, camera.cy, cell,
        tolerance, max(_BEYOND, round(_REACH * picture.blur)),
    )  # fmt: skip
    gains = 1 - (errors / tolerance) ** 2
    low = 0.0
    if picture.table is not None:
        up, height = picture.table
        low = float((part.corners @ (up @ pose[:3, :3])).min() + up @ pose[:3, 3]) + height
    agreed, refuted, hidden, unknown, beyond = areas.tolist()
    return Hypothesis(
        part, pose, pixels, gains, agreed, refuted, hidden, unknown, beyond, continued, outline,
        joined, errors, low,
    )  # fmt: skip


def bent(hypothesis: Hypothesis, picture: Picture) -> float:
    """Return how the measured surface bends against that of a part, in tolerances.

    It is the root mean square of the mean errors of patches. Noise has little of it, and what
    smoothed noise has is taken off; a surface of another shape that merely passes through the
    tolerance has much.
    """
    v, u = np.divmod(hypothesis.pixels, picture.depth.shape[1])
    side = max(int(np.sqrt(len(u)) / _PATCHES), 3)
    patch = v // side * picture.depth.shape[1] + u // side
    _, number, counts = np.unique(patch, return_inverse=True, return_counts=True)
    means = np.bincount(number, hypothesis.errors) / counts
    means = means[2 * counts >= side * side]
    if not len(means):
        return 0.0
    away = float(np.linalg.norm(hypothesis.middle))
    more = _kept(side, picture.blur) ** 2 - _kept(side, SHARP) ** 2
    noise = picture.noise * away**2 * np.sqrt(max(more, 0.0))
    return float(np.sqrt(max(np.mean(means**2) - noise**2, 0.0))) / picture.tolerance(away)


def _kept(side: int, blur: float) -> float:
    """Return the standard deviation of the mean of a patch, by that of a pixel.

    The noise is that of a camera that averages over windows of twice the blur.
    """
    short, long = sorted((float(side), 2 * blur))
    return (1 - short / (3 * long)) * (1 if side < 2 * blur else short / long)


@compiled
def _compare(
    points, normals, turn, shift, depth, cluster, fx, fy, cx, cy, cell, tolerance, beyond
):  # fmt: skip
    height, width = depth.shape
    low, high, left, right = _window(points, turn, shift, fx, fy, cx, cy, cell, height, width)
    wide = right - left
    areas = np.zeros(5)
    best = np.full((high - low) * wide, np.float32(np.inf))
    nearest = np.full((high - low) * wide, np.int32(-1))
    covered = np.zeros((high - low, wide), np.bool_)
    touched = np.empty((high - low) * wide, np.int32)
    count, least = 0, beyond
    x, n = np.empty(3), np.empty(3)
    for j in range(len(points)):
        for k in range(3):
            x[k], n[k] = shift[k], 0.0
            for other in range(3):
                x[k] += turn[k, other] * points[j, other]
                n[k] += turn[k, other] * normals[j, other]
        if x[2] <= 0.05:
            continue
        column, row = fx * x[0] / x[2] + cx, fy * x[1] / x[2] + cy
        side = cell * fx / x[2]
        area = side * side
        range_ = np.sqrt(x[0] * x[0] + x[1] * x[1] + x[2] * x[2])
        slant = abs(n[0] * x[0] + n[1] * x[1] + n[2] * x[2]) / range_
        weight = area * min(max(slant / _SLANTED - 0.6, 0.05), 1.0)
        if not (-0.5 <= column <= width - 0.5 and -0.5 <= row <= height - 0.5):
            areas[4] += weight
            continue
        reach = int(side / 2 + 1.0)
        u, v = int(column + 0.5), int(row + 0.5)
        # Seen from near, pixels between the points of two cells are within the outline, too.
        far = max(reach, int(side))
        beyond = max(beyond, least + far - reach)
        top, first = max(v - far - low, 0), max(u - far - left, 0)
        covered[top : v + far + 1 - low, first : u + far + 1 - left] = True
        aside = 1.2 * cell + 0.6 * x[2] / fx
        agrees = False
        for i in range(max(v - reach, 0), min(v + reach + 1, height)):
            for h in range(max(u - reach, 0), min(u + reach + 1, width)):
                d = depth[i, h]
                if not d > 0:
                    continue
                a, b, c = (h - cx) * d / fx - x[0], (i - cy) * d / fy - x[1], d - x[2]
                along = a * n[0] + b * n[1] + c * n[2]
                square = a * a + b * b + c * c - along * along
                # A slanted surface is uncertain across by more than its spacing.
                if abs(along) < tolerance and square < (aside + abs(c)) ** 2:
                    agrees = True
                    at = (i - low) * wide + h - left
                    if cluster[i, h] == -1:
                        continue  # the table's
                    if best[at] == np.inf:
                        touched[count] = at
                        count += 1
                    if abs(along) < abs(best[at]):
                        best[at], nearest[at] = along, j
        u, v = min(max(u, 0), width - 1), min(max(v, 0), height - 1)
        d = depth[v, u]
        if agrees:
            areas[0] += weight
        elif not d > 0:
            areas[3] += weight
        elif d < x[2]:
            areas[1 if cluster[v, u] == -1 else 2] += weight
        else:
            areas[1] += weight
    found = touched[:count].copy()
    border, goes_on, joins = 0, 0, 0
    joined = np.empty(4 * count, np.int32)
    for at in found:
        v, u = low + at // wide, left + at % wide
        j = nearest[at]
        for k in range(3):
            n[k] = 0.0
            for other in range(3):
                n[k] += turn[k, other] * normals[j, other]
        d = depth[v, u]
        for way in range(4):
            i = v + (beyond if way == 0 else -beyond if way == 1 else 0)
            h = u + (beyond if way == 2 else -beyond if way == 3 else 0)
            if not (0 <= i < height and 0 <= h < width):
                continue
            if low <= i < high and left <= h < right and covered[i - low, h - left]:
                continue
            border += 1
            c = depth[i, h]
            if cluster[i, h] < 0 or not c > 0:
                continue
            along = (
                n[0] * ((h - cx) * c - (u - cx) * d) / fx
                + n[1] * ((i - cy) * c - (v - cy) * d) / fy
                + n[2] * (c - d)
            )
            goes_on += abs(along) < tolerance
            if abs(c - d) < tolerance + beyond * d / fx:
                joined[joins] = i * width + h
                joins += 1
    errors = best[found].astype(np.float64)
    for k in range(count):
        found[k] = (low + found[k] // wide) * width + left + found[k] % wide
    return areas, found, errors, goes_on / max(border, 1), border, joined[:joins].copy()


@compiled
def _window(points, turn, shift, fx, fy, cx, cy, cell, height, width):
    """Return first and end of the rows and of the columns that posed points may touch."""
    low, high, left, right = height, 0, width, 0
    for j in range(len(points)):
        x, y, z = shift[0], shift[1], shift[2]
        for k in range(3):
            x += turn[0, k] * points[j, k]
            y += turn[1, k] * points[j, k]
            z += turn[2, k] * points[j, k]
        if z <= 0.05:
            continue
        u, v, reach = fx * x / z + cx, fy * y / z + cy, cell * fx / z + 3
        if not (-reach <= u <= width + reach and -reach <= v <= height + reach):
            continue
        left, right = min(left, int(u - reach)), max(right, int(u + reach) + 1)
        low, high = min(low, int(v - reach)), max(high, int(v + reach) + 1)
    left, right = max(left, 0), min(right, width)
    low, high = max(low, 0), min(high, height)
    return min(low, high), high, min(left, right), right
