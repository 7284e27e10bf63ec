"""Clouds that a reader can turn: a canvas each, its points in the page, one small script."""

import base64
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from qs3.report.html import escape

_CLASSES = 4
_POINTS = 1024


def encode_points(points: Float[np.ndarray, "n 3"]) -> str:
    """Return points scaled into the unit ball as base64 of little-endian 16-bit integers.

    Rows that are not finite are left out; of many points evenly spaced rows are kept.

    Example:
        >>> np.frombuffer(base64.b64decode(encode_points(np.eye(3)[:2])), "<i2").tolist()
        [23170, -23170, 0, -23170, 23170, 0]
    """
    points = points[np.isfinite(points).all(axis=1)].astype(np.float64)
    if len(points) > _POINTS:
        points = points[np.linspace(0, len(points) - 1, _POINTS).astype(np.int64)]
    if len(points):
        points = points - (points.min(axis=0) + points.max(axis=0)) / 2.0
        points /= max(float(np.linalg.norm(points, axis=1).max()), 1e-12)
    whole = np.round(points * 32767).astype("<i2")
    return base64.b64encode(whole.tobytes()).decode("ascii")


def viewer(samples: Mapping[str, Mapping[str, Sequence[np.ndarray]]]) -> str:
    """Return canvases with one cloud of some classes of each domain, beside one another.

    The part is hidden until its script shows it. Empty where no class is in every domain.
    """
    shared = [
        name
        for name in next(iter(samples.values()), {})
        if all(len(classes.get(name, ())) for classes in samples.values())
    ]
    # Evenly spaced in the list, so that more than its beginning is seen.
    spots = np.linspace(0, len(shared) - 1, min(_CLASSES, len(shared))).astype(int)
    figures = [
        f'<figure><canvas tabindex="0" role="img" aria-label="{escape(f"{name}, {domain}")}, '
        f'can be turned" data-points="{encode_points(np.asarray(classes[name][0]))}"></canvas>'
        f"<figcaption>{escape(f'{name}, {domain}')}</figcaption></figure>"
        for name in (shared[spot] for spot in spots)
        for domain, classes in samples.items()
    ]
    if not figures:
        return ""
    canvases = "\n".join(figures)
    return (
        '<div id="viewer" hidden><h3>Turn them</h3>\n'
        '<p class="soft">Drag sideways, or use the arrow keys: all clouds turn together.</p>\n'
        f'<div class="viewer">\n{canvases}\n</div></div>'
    )
