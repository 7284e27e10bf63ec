"""Pixels of the background in a mask that bleeds, found by the depth image around it."""

import numpy as np
from jaxtyping import Bool, Float, Float32

_REACH = 3  # times the width of the rim: how far around it the background is looked at
_SIGMAS = 3.0
_FLOOR = 1e-3  # share of the depth: a camera that is better than this is not known
_ROUGH = 0.005  # share of the depth: a background that is rougher is no plane
_FEWEST = 12  # pixels that show the background


def on_object(
    depth: Float32[np.ndarray, "h w"],
    mask: Bool[np.ndarray, "h w"],
    outside: Bool[np.ndarray, "h w"],
    width: int,
) -> Bool[np.ndarray, "h w"]:
    """Return a mask without those pixels of its rim that continue the background.

    Through the background near each pixel within ``width`` of the mask's edge a plane is laid; in
    1/z, in which planes are linear and the noise of a stereo camera is even. A pixel on it within
    three standard deviations of that background is the background's. An object of which the inner
    pixels lie there too, such as a sheet of paper, keeps all; so do pixels with no plain background
    nearby, such as those before a hole or an edge.

    Args:
        depth: Metres, 0 or NaN if there is none.
        mask: Pixels of the object.
        outside: Pixels of its surroundings; not those of other objects.
        width: Pixels by which the mask may bleed.
    """
    import cv2

    if not width or not mask.any():
        return mask
    margin = (_REACH + 1) * width
    rows, columns = (np.flatnonzero(mask.any(axis=axis)) for axis in (1, 0))
    part = tuple(
        slice(max(0, int(line[0]) - margin), int(line[-1]) + margin + 1) for line in (rows, columns)
    )
    near, around, z = mask[part], outside[part] & ~mask[part], depth[part].astype(np.float64)
    with np.errstate(invalid="ignore"):
        seen = np.isfinite(z) & (z > 0)
    inverse = np.where(seen, 1 / np.where(seen, z, 1.0), 0.0)
    plane, spread, count = _background(inverse, around & seen, _REACH * width)
    with np.errstate(invalid="ignore"):
        floor = _FLOOR * plane
        is_plain = (count >= _FEWEST) & (spread <= _ROUGH * plane)
        off = np.abs(inverse - plane)
        behind = near & seen & is_plain & (off <= np.maximum(_SIGMAS * spread, floor))
    # The image's own border is no edge of a mask.
    inward = cv2.distanceTransform(np.pad(near, 1, mode="edge").astype(np.uint8), cv2.DIST_L2, 5)
    inward = inward[1:-1, 1:-1]
    inner = near & seen & (inward >= min(width + 1, float(inward[seen].max(initial=0.0)) - 1))
    kept = mask.copy()
    if 2 * (behind & inner).sum() < inner.sum():
        kept[part] &= ~(behind & (inward < width + 1))
    return kept


def _background(
    values: Float[np.ndarray, "h w"], known: Bool[np.ndarray, "h w"], reach: int
) -> tuple[Float[np.ndarray, "h w"], Float[np.ndarray, "h w"], Float[np.ndarray, "h w"]]:
    """Fit a plane to the known values within ``reach`` of each pixel.

    Returns its value there, the standard deviation of the known values from it, and their number.
    """
    import cv2

    v, u = np.indices(values.shape, dtype=np.float64)
    u, v = u - u.mean(), v - v.mean()
    size = (2 * reach + 1,) * 2

    def total(layer: np.ndarray) -> np.ndarray:
        layer, border = np.where(known, layer, 0.0), cv2.BORDER_CONSTANT
        return cv2.boxFilter(layer, -1, size, normalize=False, borderType=border)

    count = total(np.ones_like(values))
    some = np.maximum(count, 1.0)
    mean_u, mean_v, mean = (total(layer) / some for layer in (u, v, values))
    uu, uv, vv = (
        total(a * b) / some - p * q
        for a, b, p, q in (
            (u, u, mean_u, mean_u),
            (u, v, mean_u, mean_v),
            (v, v, mean_v, mean_v),
        )
    )
    ux, vx = (total(a * values) / some - p * mean for a, p in ((u, mean_u), (v, mean_v)))
    across = uu * vv - uv**2
    is_wide = across > 1.0  # px⁴; on a line the plane could tilt
    safe = np.where(is_wide, across, 1.0)
    along_u, along_v = (ux * vv - vx * uv) / safe, (vx * uu - ux * uv) / safe
    square = total(values**2) / some - mean**2 - along_u * ux - along_v * vx
    freedom = some / np.maximum(some - 3, 1.0)
    spread = np.sqrt(np.maximum(square * freedom, 0.0))
    plane = mean + along_u * (u - mean_u) + along_v * (v - mean_v)
    return plane, spread, np.where(is_wide, count, 0.0)
