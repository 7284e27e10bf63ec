"""Clouds that a reader can turn: a canvas a domain, the points in the page, one small script."""

import base64
from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Float

from qs3.report.html import escape
from qs3.report.records import Cloud

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


def viewer(clouds: Mapping[str, Sequence[Cloud]], class_names: Sequence[str]) -> str:
    """Return one canvas a domain, side by side, and what steps through the clouds of a class.

    The part is hidden until its script shows it; a cloud is decoded when it is its turn. Empty
    where there is no cloud.

    Args:
        clouds: Clouds of each domain.
        class_names: Classes in the order in which the reader chooses them.
    """
    shown = [name for name in class_names if any(_of(c, name) for c in clouds.values())]
    if not shown:
        return ""
    options = "".join(
        f'<option value="{index}">{escape(name)}</option>' for index, name in enumerate(shown)
    )
    figures = "\n".join(
        f'<figure data-domain="{escape(domain)}"><canvas tabindex="0" role="img" '
        f'aria-label="{escape(domain)}, can be turned"></canvas><figcaption></figcaption>\n'
        f"<div hidden>\n{_listed(own, shown)}\n</div></figure>"
        for domain, own in clouds.items()
    )
    return (
        '<div id="viewer" hidden><h3>Turn them</h3>\n'
        '<p class="soft">Drag sideways, or use the arrow keys: all clouds turn together.</p>\n'
        '<div class="steer"><label>Class <select><option value="">all classes</option>'
        f'{options}</select></label><button type="button" data-step="-1">‹ Previous</button>'
        '<button type="button" data-step="1">Next ›</button>'
        '<output aria-live="polite"></output></div>\n'
        f'<div class="viewer">\n{figures}\n</div></div>'
    )


def _listed(clouds: Sequence[Cloud], class_names: Sequence[str]) -> str:
    return "\n".join(
        f'<i data-class="{index}" data-note="{escape(cloud.note)}" '
        f'data-points="{encode_points(np.asarray(cloud.points))}"></i>'
        for index, name in enumerate(class_names)
        for cloud in _of(clouds, name)
    )


def _of(clouds: Sequence[Cloud], class_name: str) -> list[Cloud]:
    return [cloud for cloud in clouds if cloud.class_name == class_name]
