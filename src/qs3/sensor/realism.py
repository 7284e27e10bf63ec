"""A real infrared pair through our matcher, beside the depth that its own camera made of it."""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float

from qs3.errors import InputError
from qs3.sensor.matching import Image, MatchingSettings, match

LAGS = (1, 4, 8)
"""Pixels apart. A D415 on a table: 0.97, 0.82, 0.52 with 0.131 px RMS (0.10 to 0.18)."""
PATCH = (80, 60)
"""Columns and rows of the patches in which planes are searched."""
STEP, REACH = 4.0, 8
"""Pixels of disparity that are a step between two surfaces, and pixels around it."""

_FLAT = 0.5  # pixels of disparity off a plane that are its noise: 3 to 4 σ of a D4xx
_OFF = 3.0  # pixels of disparity beyond which a match is simply wrong
_SCALE = 0.01  # of all disparities, beyond which f·b is not the camera's


@dataclass(frozen=True)
class InfraredPair:
    """A rectified pair of images, and the camera's own depth of the left one."""

    left: Image
    """Grey levels of 8 bits, or of 10 bits in 16."""
    right: Image
    depth: Float[np.ndarray, "h w"]
    """Depth along the optical axis in metres, NaN if there is none; the left image's pixels."""
    focal: float
    baseline: float

    def __post_init__(self) -> None:
        if not (self.focal > 0 and 0 < self.baseline < math.inf):
            raise InputError(f"baseline {self.baseline:g}: must be metres above 0")
        if not np.isfinite(self.depth).any():
            raise InputError("pair: the depth image holds no depth at all")
        middle = np.nanmedian(self.disparity)
        if not 0.5 < middle < self.left.shape[1] / 2:
            raise InputError(
                f"pair: f·b/z is {middle:.3g} px at the middle depth of "
                f"{np.nanmedian(self.depth):.3g} m; baseline is in metres, and --depth-scale gives "
                "the metres per step of the depth image"
            )

    @property
    def disparity(self) -> Float[np.ndarray, "h w"]:
        """The camera's own depth as disparity f·b/z in pixels."""
        return self.focal * self.baseline / self.depth.astype(np.float64)


@dataclass(frozen=True)
class Comparison:
    """Our matcher's result of a pair, beside the camera's."""

    disparity: Float[np.ndarray, "h w"]
    matching: MatchingSettings
    """The matcher, with the search range that this depth needs."""
    figures: dict[str, Any]
    """Plain values, None if there is nothing to measure; `docs/realism.md` lists them."""


def compare(pair: InfraredPair, settings: MatchingSettings) -> Comparison:
    """Match a real pair and measure the result beside the camera's own depth."""
    camera = pair.disparity
    settings = search_range(pair, settings)
    ours = match(pair.left, pair.right, settings).astype(np.float64)
    in_view, patches = in_sight(camera), planar_patches(camera)
    common = in_view & np.isfinite(ours) & np.isfinite(camera)
    difference = (ours - camera)[common]
    off = np.abs(difference)
    figures: dict[str, Any] = {
        "median_abs_px": _median(off),
        "difference_px": _median(difference),
        "scale": _median(ours[common] / camera[common]),
        "over_1px": _share(off > 1),
        "over_1px_near_steps": _share(off[near_steps(camera)[common]] > 1),
        "over_3px": _share(off > _OFF),
        "planes": len(patches),
    }
    for prefix, made, other in (("", ours, camera), ("camera_", camera, ours)):
        rms, along = plane_noise(made, patches)
        figures |= {
            f"{prefix}valid": _share(np.isfinite(made)[in_view]),
            f"{prefix}holes": _share((np.isfinite(other) & np.isnan(made))[in_view]),
            f"{prefix}plane_rms_px": plain(rms),
            f"{prefix}autocorrelation": plain(along),
        }
    return Comparison(ours, settings, figures | {"notes": _notes(figures)})


def _notes(figures: dict[str, Any]) -> list[str]:
    notes, scale = [], figures["scale"]
    if scale is None or figures["median_abs_px"] > _OFF:
        notes.append(
            "most disparities are more than 3 px off the camera's: are LEFT and RIGHT swapped, or "
            "focal length, baseline or depth scale another camera's?"
        )
    elif abs(scale - 1) > _SCALE:
        notes.append(
            f"our disparities are {scale:.3f} times the camera's: is the focal length or baseline "
            "another camera's?"
        )
    if not figures["planes"]:
        notes.append(f"no plane of {PATCH[0]} × {PATCH[1]} px in the camera's depth: no noise")
    return notes


def search_range(pair: InfraredPair, settings: MatchingSettings) -> MatchingSettings:
    """The settings with as many disparities as the nearest depth needs, a few strays aside."""
    needed = float(np.nanquantile(pair.disparity, 0.999)) + settings.block_size
    room = min(1024, pair.left.shape[1] - settings.block_size) // 16 * 16
    wanted = max(settings.num_disparities, min(16 * math.ceil(needed / 16), room))
    return dataclasses.replace(settings, num_disparities=wanted)


def in_sight(camera: Float[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Pixels that can have a depth: within the camera's frame, their match in the right image.

    Its frame reaches from the first to the last row and column with any depth, strays aside (fewer
    than a tenth of what the median row or column has): cameras and their tools leave a border
    empty. The match of the left band of f·b/z columns lies outside the right image. If there is
    no disparity, that of the next pixel to the right that has one is taken.
    """
    width = camera.shape[1]
    columns = np.arange(width)
    frame = np.ones(camera.shape, dtype=bool)
    for axis in (0, 1):
        count = np.isfinite(camera).sum(axis=axis)
        held = np.flatnonzero(count >= max(1.0, 0.1 * np.median(count[count > 0])))
        outside = (np.arange(len(count)) < held[0]) | (np.arange(len(count)) > held[-1])
        frame &= np.expand_dims(~outside, axis)
    valid = np.where(np.isfinite(camera), columns, width)
    following = np.minimum.accumulate(valid[:, ::-1], axis=1)[:, ::-1]
    nearest = np.take_along_axis(camera, np.minimum(following, width - 1), axis=1)
    seen = np.where(following < width, columns >= nearest, columns >= np.nanmedian(camera))
    return seen & frame


def near_steps(disparity: Float[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Pixels within `REACH` of which the disparity differs by `STEP` or more."""
    import cv2

    around, valid = np.ones((2 * REACH + 1, 2 * REACH + 1)), np.isfinite(disparity)
    high = cv2.dilate(np.where(valid, disparity, 0.0), around)
    return high - cv2.erode(np.where(valid, disparity, 1e6), around) >= STEP


def planar_patches(camera: Float[np.ndarray, "h w"]) -> list[tuple[int, int]]:
    """First column and row of patches in which 95 % of the pixels lie within 0.5 px of a plane."""
    wide, high = PATCH
    return [
        (x, y)
        for y in range(0, camera.shape[0] - high + 1, high // 2)
        for x in range(0, camera.shape[1] - wide + 1, wide // 2)
        if (np.abs(off_plane(camera[y : y + high, x : x + wide])) < _FLAT).mean() >= 0.95
    ]


def plane_noise(
    disparity: Float[np.ndarray, "h w"], patches: Sequence[tuple[int, int]]
) -> tuple[float, Float[np.ndarray, "3"]]:
    """RMS in pixels about the planes of patches, and autocorrelation along x at `LAGS`; medians.

    Patches of which less than half lies within 1 px of a plane are left out; NaN if none is left.
    """
    figures = []
    for x, y in patches:
        rest = off_plane(disparity[y : y + PATCH[1], x : x + PATCH[0]])
        if np.isfinite(rest).mean() >= 0.5:
            rest = rest - np.nanmean(rest)
            figures.append([math.sqrt(np.nanmean(rest**2)), *autocorrelation(rest, LAGS)])
    rms, *along = np.median(figures, axis=0) if figures else np.full(1 + len(LAGS), np.nan)
    return float(rms), np.array(along)


def _median(values: Float[np.ndarray, "n"]) -> float | None:
    return float(np.median(values)) if values.size else None


def _share(chosen: Bool[np.ndarray, "..."]) -> float | None:
    return float(chosen.mean()) if chosen.size else None


def plain(value: Any) -> Any:
    """Return numbers as floats, arrays and sequences as lists, and None for what is not finite."""
    if isinstance(value, (list, tuple, np.ndarray)):
        return [plain(part) for part in value]
    return None if value is None or not math.isfinite(value) else float(value)


def off_plane(disparity: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Residuals of the plane in disparity that fits what lies within 1 px of it.

    A plane in space is one in disparity. The others are NaN; all are if they are more than half.
    """
    v, u = np.mgrid[: disparity.shape[0], : disparity.shape[1]]
    design = np.stack([u, v, np.ones_like(u)], axis=-1).astype(np.float64)
    rest = disparity.astype(np.float64)
    kept = np.isfinite(rest)
    for _ in range(3):
        if kept.mean() < 0.5:
            return np.full(rest.shape, np.nan)
        plane, *_ = np.linalg.lstsq(design[kept], disparity[kept], rcond=None)
        rest = disparity - design @ plane
        kept = np.abs(rest) < 1
    return np.where(kept, rest, np.nan)


def autocorrelation(rest: Float[np.ndarray, "h w"], lags: Sequence[int]) -> list[float]:
    """Correlation of residuals with those ``lags`` pixels away along x; NaN without residuals."""
    if not np.isfinite(rest).any():
        return [math.nan] * len(lags)
    power = max(np.nanmean(rest**2), 1e-12)
    return [float(np.nanmean(rest[:, lag:] * rest[:, :-lag]) / power) for lag in lags]
