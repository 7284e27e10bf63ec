"""How well the visible surface of a part, in a pose, agrees with a scan: both ways, in metres."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32

from qs3.parts.align import off_disc, pair
from qs3.parts.scan import Scan
from qs3.points.compiled import compiled

_TRIMMED = 0.92
"""Share of the distances, the smallest, that make the residual."""
_STRAY = 3.0
"""Noises at which the likelihood counts a point as a stray."""
_CALM, _SHOWN = 2.0, 0.5
"""Noises that count as one in `Score.misfit`, and the weight there of surface that the scan misses:
a weak sign, as cameras do not see dark, shiny and slanted places."""
_LEAST_NOISE = 0.0007
"""Metres: scans and CAD agree no better than this."""
DEEP = 3.5
"""How many times less certain depth is than what lies across the line of sight: of 1, 2, 3.5 and 6
the one by which CAD alone names the most simulated scans (d435 and an Xtion, parts on a table)."""
_SLANTED = 0.25
"""Cosine at which a camera begins to see a surface: weight of a visible point, 0 to 1."""


@dataclass(frozen=True)
class Score:
    """Agreement of a pose with a scan."""

    residual: float
    """Metres: root mean square distance of points of the scan to the visible surface and of the
    visible surface to the scan, the mean of both squares, over the nearest 92 % of each."""
    off: float
    """Metres: root mean square distance of the nearest 92 % of the scan to the visible surface."""
    visible: float
    """Share of the picture of the visible surface that the scan covers: a measured point lies
    within three noises in front or behind, `DEEP` times larger there, and beside it no farther than
    points lie apart."""
    explained: float
    """Share of the scan that lies on the visible surface within three noises, `DEEP` times larger
    ones along the line of sight."""
    log_likelihood: float
    """Chooses the pose of a CAD file: minus half the sum of robust squares in noises, of 50
    independent points each way; along the line of sight a noise is `DEEP` times larger."""
    misfit: float
    """The same sum, positive and more forgiving: of twice the noise, and with half the weight of
    surface that the scan misses."""


def noise_of(scan: Scan) -> float:
    """Return the scale of the distances between a scan and its own CAD in the right pose, metres.

    It holds the noise along the surface, and a share of the spacing: edges are uncertain by it.
    """
    return float(np.sqrt(_LEAST_NOISE**2 + (1.5 * scan.noise) ** 2 + (0.5 * scan.spacing) ** 2))


def score(
    scan: Scan,
    count: int,
    points: Float32[np.ndarray, "m 3"],
    normals: Float32[np.ndarray, "m 3"],
    gap: float,
    turn: Float[np.ndarray, "3 3"],
    shift: Float[np.ndarray, "3"],
    eye: Float[np.ndarray, "3"],
    noise: float,
) -> Score:
    """Score a pose by the first points of a scan and the visible points of a part.

    ``gap`` is the spacing of these, ``eye`` is the camera in the scan's axes.
    """
    scan_gap = scan.spacing * np.sqrt(len(scan.points) / count)
    near = scan.points[:count], scan.normals[:count], points, normals
    sight = eye / np.linalg.norm(eye)
    out, home, plain_out, plain_home, beside, weight = _distances(
        *near, turn, shift, eye, gap, scan_gap, (3 * noise) ** 2, sight, DEEP
    )
    order = np.sort(plain_out)[: max(1, int(_TRIMMED * len(out)))]
    forward = float(np.mean(order**2))
    backward = _trimmed(plain_home, weight)
    squares, calm = (
        (_robust(out, None, scale), _robust(home, weight, scale))
        for scale in (noise, _CALM * noise)
    )
    return Score(
        float(np.sqrt((forward + backward) / 2)),
        float(np.sqrt(forward)),
        float(((home < _STRAY * noise) & (beside < max(scan_gap / 2, noise))).mean()),
        float((out < _STRAY * noise).mean()),
        -25.0 * sum(squares),
        25.0 * (calm[0] + _SHOWN * calm[1]),
    )


def _robust(values: np.ndarray, weight: np.ndarray | None, noise: float) -> float:
    """Return the mean square of distances in noises; a stray counts no more than `_STRAY`."""
    square = (values / noise) ** 2
    return float(np.average(square / (1 + square / _STRAY**2), weights=weight))


def _trimmed(values: np.ndarray, weight: np.ndarray) -> float:
    order = np.argsort(values, kind="stable")
    total = np.cumsum(weight[order])
    kept = order[total <= _TRIMMED * total[-1]]
    return float(np.average(values[kept] ** 2, weights=weight[kept])) if len(kept) else 0.0


@compiled
def _distances(
    scan,
    scan_normals,
    points,
    normals,
    turn,
    shift,
    eye,
    gap,
    scan_gap,
    across,
    sight,
    deep,
):
    """Return distances scan to part and part to scan, flattened (see `qs3.parts.align`) and plain.

    Also what the flattened ones of the latter have beside the normal, and weights by slant.
    """
    near, back = pair(scan, scan_normals, points, normals, turn, shift, across, sight, deep)
    n, m = len(scan), len(points)
    out, home, plain_out, plain_home = np.empty(n), np.empty(m), np.empty(n), np.empty(m)
    beside, weight = np.empty(m), np.empty(m)
    x, normal, miss = np.empty(3), np.empty(3), np.empty(3)
    for number in range(n + m):
        if number < n:
            i, j, allowed = number, near[number], gap
        else:
            i, j, allowed = back[number - n], number - n, scan_gap
        along, _, excess, _ = off_disc(
            scan, points, normals, i, j, turn, shift, allowed, sight, deep, x, normal, miss
        )
        flat = np.sqrt(along * along + excess * excess)
        along, _, aside, _ = off_disc(
            scan, points, normals, i, j, turn, shift, allowed, sight, 1.0, x, normal, miss
        )
        plain = np.sqrt(along * along + aside * aside)
        if number < n:
            out[number], plain_out[number] = flat, plain
        else:
            home[j], plain_home[j], beside[j] = flat, plain, excess
            away, slant = 0.0, 0.0
            for k in range(3):
                ahead = eye[k] - x[k]
                away += ahead * ahead
                slant += ahead * normal[k]
            weight[j] = min(max(abs(slant) / np.sqrt(away) / _SLANTED - 0.6, 0.05), 1.0)
    return out, home, plain_out, plain_home, beside, weight
