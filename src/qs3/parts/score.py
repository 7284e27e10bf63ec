"""How well the visible surface of a part, in a pose, agrees with a scan: both ways, in metres.

The residual leaves the farthest points of each side out (`_TRIMMED`); what decides, the misfit and
the likelihood, takes all of them with a robust cost.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32

from qs3.parts.align import columns_of, flat_of, off_discs, pair, placed
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
    visible surface to the scan, the mean of both squares, over the nearest `_TRIMMED` of each."""
    off: float
    """Metres: root mean square distance of the nearest `_TRIMMED` of the scan to the visible
    surface."""
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
    scan_gap = scan.gap(count)
    near = scan.points[:count], scan.normals[:count], points, normals
    out, home, plain_out, plain_home, beside, weight = _distances(
        *near, turn, shift, eye, gap, scan_gap, (3 * noise) ** 2, DEEP
    )
    order = np.sort(plain_out)[: max(1, int(_TRIMMED * len(out)))]
    forward = float((order**2).mean())
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
    return _mean(square / (1 + square / _STRAY**2), weight)


def _mean(values: np.ndarray, weight: np.ndarray | None) -> float:
    """Return what `np.average` does, without its checks."""
    if weight is None:
        return float(values.mean())
    return float((values * weight).sum() / weight.sum())


def _trimmed(values: np.ndarray, weight: np.ndarray) -> float:
    order = np.argsort(values, kind="stable")
    total = np.cumsum(weight[order])
    kept = order[total <= _TRIMMED * total[-1]]
    return _mean(values[kept] ** 2, weight[kept]) if len(kept) else 0.0


@compiled
def _distances(scan, normals, points, part_normals, turn, shift, eye, gap, scan_gap, across, deep):
    """Return distances scan to part and part to scan, flattened (see `qs3.parts.align`) and plain.

    Also what the flattened ones of the latter have beside the normal, and weights by slant.
    """
    sight, n = eye / np.sqrt((eye * eye).sum()), len(scan)
    fixed, part = columns_of(scan, normals), columns_of(points, part_normals)
    flat = (
        placed(fixed, np.eye(3), np.zeros(3), sight, deep),
        placed(part, turn, shift, sight, deep),
    )
    plain = placed(fixed, np.eye(3), np.zeros(3), sight, 1.0), placed(part, turn, shift, sight, 1.0)
    pairs = pair(flat_of(flat[0]), n, flat[1], across)
    along, _, beside = off_discs(flat[0], flat[1], pairs, gap, scan_gap)
    flatly = np.sqrt(along * along + beside * beside)
    along, _, excess = off_discs(plain[0], plain[1], pairs, gap, scan_gap)
    plainly = np.sqrt(along * along + excess * excess)
    weight = np.empty(len(points))
    for j in range(len(points)):
        away, slant = 0.0, 0.0
        for k in range(3):
            ahead = eye[k] - plain[1][k, j]
            away += ahead * ahead
            slant += ahead * plain[1][3 + k, j]
        weight[j] = min(max(abs(slant) / np.sqrt(away) / _SLANTED - 0.6, 0.05), 1.0)
    return flatly[:n], flatly[n:], plainly[:n], plainly[n:], beside[n:], weight
