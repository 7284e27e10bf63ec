"""Normals of a depth picture: planes through the pixels around each."""

import numpy as np
from jaxtyping import Float32, Int32

from qs3.parts.scenes.picture import Picture
from qs3.points.compiled import compiled

_REACH = 0.006
"""Metres around a pixel that a plane is fitted to."""
_STEP = 3
"""Reaches by which the depth of a pixel around may differ."""


def normals_of(picture: Picture, pixels: Int32[np.ndarray, "n"]) -> Float32[np.ndarray, "n 3"]:
    """Return unit normals towards the camera at flat indices of pixels; NaN if there is none.

    The inverse depth of a plane is linear in the pixels: three unknowns.
    """
    camera = picture.camera
    return _fitted(picture.depth, pixels, camera.fx, camera.fy, camera.cx, camera.cy)


@compiled
def _fitted(depth, pixels, fx, fy, cx, cy):
    height, width = depth.shape
    normals = np.full((len(pixels), 3), np.float32(np.nan))
    for k in range(len(pixels)):
        v, u = pixels[k] // width, pixels[k] % width
        middle = depth[v, u]
        reach = min(max(int(_REACH * fx / middle + 0.5), 2), 12)
        a = np.zeros((3, 3))
        b = np.zeros(3)
        count = 0
        for i in range(max(v - reach, 0), min(v + reach + 1, height)):
            for j in range(max(u - reach, 0), min(u + reach + 1, width)):
                d = depth[i, j]
                if not d > 0 or abs(d - middle) > _STEP * _REACH:
                    continue
                x, y, w = float(j - u), float(i - v), 1 / d - 1 / middle
                a[0, 0] += x * x
                a[0, 1] += x * y
                a[0, 2] += x
                a[1, 1] += y * y
                a[1, 2] += y
                b[0] += x * w
                b[1] += y * w
                b[2] += w
                count += 1
        if count < 6:
            continue
        a[2, 2] = count
        p = a[0, 0] - a[0, 2] * a[0, 2] / count
        q = a[0, 1] - a[0, 2] * a[1, 2] / count
        r = a[1, 1] - a[1, 2] * a[1, 2] / count
        e, f = b[0] - a[0, 2] * b[2] / count, b[1] - a[1, 2] * b[2] / count
        det = p * r - q * q
        if not det > 1e-9 * max(p * r, 1e-9):
            continue
        s, t = (r * e - q * f) / det, (p * f - q * e) / det
        c = 1 / middle + (b[2] - s * a[0, 2] - t * a[1, 2]) / count
        x, y = s * fx, t * fy
        z = c - x * (u - cx) / fx - y * (v - cy) / fy
        length = -np.sqrt(x * x + y * y + z * z)
        normals[k, 0], normals[k, 1], normals[k, 2] = x / length, y / length, z / length
    return normals
