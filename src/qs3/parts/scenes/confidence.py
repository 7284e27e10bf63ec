"""How probable it is that a part was found rightly: a logistic of what the picture says of it.

The weights are fitted on simulated scenes of other parts than those of the results:
``benchmarks/confidence.py`` prints them.
"""

from collections.abc import Iterable, Sequence

import numpy as np
from jaxtyping import Float

from qs3.geometry import invert_rigid, transform_points
from qs3.parts.scenes.picture import Picture
from qs3.parts.scenes.verifying import Hypothesis, bent

FEATURES = ("bent", "continued", "free", "rival", "unknown", "refuted", "hidden")
WEIGHTS = (-8.85, -8.71, -11.67, -4.52, -3.97, -1.81, -2.09)
BIAS = 6.26
"""Weights of the `FEATURES`, and the logit of a part without any fault."""
_SMOOTHED, _COST = 0.25, 60.0
"""Share of a part's diameter that the camera smooths over up to which answers are right, and what
more of it costs: of simulated frames of a D435 and a D415, 0.3 to 0.8 m and 0.46 to 1.1 m away, of
other parts than those of the results."""
_BENT = 0.5
"""Largest bend that counts."""
_HARMLESS, _RIVAL = 0.5, 0.7
"""Value up to which a rival does not count, and how far beyond it does."""
_COPIED, _MANY = 0.5, 5
"""By how much less `free` counts among many copies, and how many are many."""
_SAME = 0.1
"""Diameters by which two poses of a part may differ to be one."""
_COMPARED = 200
"""Points of a part by which two poses are compared."""


def rival_of(hypothesis: Hypothesis, others: Iterable[Hypothesis]) -> float:
    """Return the value of the best other part or pose in the same place, by that of this one.

    It is in the same place if it holds half of the pixels. 0 if there is none.
    """
    pixels = np.sort(hypothesis.pixels)
    for other in sorted(others, key=lambda h: -h.value):
        if other is hypothesis or other.value <= 0:
            continue
        at = np.searchsorted(pixels, other.pixels).clip(max=len(pixels) - 1)
        shared = int((pixels[at] == other.pixels).sum())
        if 2 * shared >= len(pixels) and not _same(hypothesis, other):
            return float(other.value / max(hypothesis.value, 1e-9))
    return 0.0


def _same(one: Hypothesis, other: Hypothesis) -> bool:
    """Return whether two hypotheses are one part in one pose, or in poses that look the same."""
    part = one.part
    if other.part is not part:
        return False
    points = part.points[:: max(1, len(part.points) // _COMPARED)].astype(np.float64)
    between = part.symmetry.canonical(invert_rigid(one.pose) @ other.pose)
    away = np.linalg.norm(transform_points(between, points) - points, axis=1)
    return float(away.mean()) < _SAME * part.diameter


def features(
    hypothesis: Hypothesis, chosen: Sequence[Hypothesis], picture: Picture, copies: int = 0
) -> Float[np.ndarray, "f"]:
    """Return the `FEATURES` of a part: all are 0 for one that stands alone and is seen whole.

    - bent: mean bend of the measured surface against that of the part, in tolerances;
    - continued: share of the outline beyond which the same surface goes on;
    - free: share of the outline beyond which something is joined that no chosen part explains;
      among copies of the part that is likely a further one, and counts less;
    - rival: see `rival_of`; one that explains half as much is none;
    - unknown: what has no depth, as a share of this and what is measured on the part;
    - refuted: what is seen through, as a share of this and what is measured on the part;
    - hidden: share of the surface towards the camera, also beyond the picture, that is not measured
      on the part, for whatever reason: what is unknown or refuted is counted here too.
    """
    h = hypothesis
    claimed = np.zeros(picture.depth.size, dtype=bool)
    for other in chosen:
        if other is not h:
            claimed[other.pixels] = True
    free = int((~claimed[h.joined]).sum()) / max(h.outline, 1)
    free *= 1 - _COPIED * min(copies / _MANY, 1.0)
    return np.array([
        min(bent(h, picture), _BENT), h.continued, free, min(max(h.rival - _HARMLESS, 0.0), _RIVAL),
        h.unknown / max(h.agreed + h.unknown, 1e-9), h.refuted / max(h.agreed + h.refuted, 1e-9),
        1 - h.agreed / max(h.area + h.beyond, 1e-9),
    ])  # fmt: skip


def confidence(
    hypothesis: Hypothesis, chosen: Sequence[Hypothesis], picture: Picture, copies: int = 0
) -> float:
    """Return the probability that class and pose of a chosen part are right.

    ``copies`` are further parts of its CAD file in the picture that are sure.
    """
    logit = BIAS + float(features(hypothesis, chosen, picture, copies) @ np.array(WEIGHTS))
    window = 2 * picture.blur * float(hypothesis.middle[2]) / picture.camera.fx
    logit -= _COST * max(window / hypothesis.part.diameter - _SMOOTHED, 0.0)
    return float(1 / (1 + np.exp(-logit)))
