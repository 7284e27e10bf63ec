"""Limits that a part keeps to be an answer at all, and to be so good that no other is sought."""

import numpy as np

from qs3.parts.scenes.found import LEAST
from qs3.parts.scenes.picture import Picture
from qs3.parts.scenes.verifying import SHARP, Hypothesis, bent

_CONTINUED = 0.45
"""Share of the outline of a part that may lie within a larger surface."""
_BENT = 0.27
"""Tolerances of `bent` up to which a part is good: on simulated tables right poses have
0.02 to 0.26, and parts of another shape 0.26 to 0.4."""
_AGREED = 0.5
"""Least agreement of a part with the picture."""
_BEYOND, _FILLING, _BORDER = 1.0, 0.5, 6
"""Most of the visible surface that lies beyond the picture, by what lies within; the second of a
part that comes within the third, in pixels, of two borders: it shows little outline, and agrees
with parts of many kinds."""
_CLUSTERED = 0.5
"""Least share of the pixels of a part that stand on the table: none beyond its rim do."""
_SUNK = 0.1
"""Diameters by which a part may reach under the table, at most, if the camera smooths depth: to one
that does not a part that lies in a hole is as sure as another."""


def is_good(picture: Picture, hypothesis: Hypothesis) -> bool:
    """Return whether a part in its pose may explain its pixels."""
    return (
        hypothesis.agreement >= _AGREED
        and _straight(picture, hypothesis)
        and hypothesis.continued <= _CONTINUED
        and min(len(hypothesis.pixels), hypothesis.agreed) >= LEAST  # pixels may lie beside it
        and (picture.blur <= SHARP or hypothesis.low >= -_SUNK * hypothesis.part.diameter)
        and hypothesis.beyond <= _most_beyond(picture, hypothesis) * hypothesis.area
        and float(np.mean(picture.cluster.flat[hypothesis.pixels] >= 0)) >= _CLUSTERED
    )


def _most_beyond(picture: Picture, hypothesis: Hypothesis) -> float:
    height, width = picture.depth.shape
    v, u = np.divmod(hypothesis.pixels, width)
    ends = (v.min(), height - 1 - v.max(), u.min(), width - 1 - u.max())
    return _BEYOND if sum(end < _BORDER for end in ends) < 2 else _FILLING


def is_sure(picture: Picture, hypothesis: Hypothesis) -> bool:
    """Return whether a part is so good that no other is sought for its pixels."""
    seen = hypothesis.agreement >= 0.9 and hypothesis.continued <= 0.1
    return seen and _straight(picture, hypothesis)


def _straight(picture: Picture, hypothesis: Hypothesis) -> bool:
    """Return whether the measured surface follows that of the part."""
    return bent(hypothesis, picture) <= _BENT
