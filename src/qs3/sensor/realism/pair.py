"""A real infrared pair through our matcher, beside the depth that its own camera made of it.

Where surfaces end is taken from the left image, so that both are judged by a third: a step of the
camera's disparity tells where to look, along which line, and which side is near; the edge is where
grey levels change most near that line, averaged along it so that spots and texture cancel.
"""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from qs3.errors import InputError
from qs3.sensor.matching import Image, MatchingSettings, match
from qs3.sensor.realism.rows import plain

PATCH = (80, 60)
"""Columns and rows of the patches that are looked at for planes."""
LAGS = (1, 4, 8)
"""Pixels along x at which the noise of planes is held against itself."""

_STEP = 4.0  # least step of disparity at an edge: a D4xx tells it from any noise
_LAG = 3  # pixels on either side of a step that may show a depth in between
_ALONG = 15  # rows up and down the line through an edge
_ACROSS = 16  # columns to either side of it in which grey levels change
_NEARNESS = 4.0  # σ of the weight by which the change nearest to the line is preferred
_CONTRAST = 3.0  # at an edge each third of the line changes by as many medians, or 2 σ of noise
_INSIDE, _OUTSIDE = 8, 20  # columns about an edge in which a surface may end
_FEWEST = 20  # pixels of edges, and of these on a side, that a median is told of
_FLAT = 0.5  # pixels of disparity off a plane that are its noise: 3 to 4 σ of a D4xx
_OFF = 3.0  # pixels of disparity beyond which a match is simply wrong
_SCALE = 0.01  # of all disparities, beyond which f·b is not the camera's
_SIDES = {(1, 0): "right", (0, 1): "lower", (-1, 0): "left", (0, -1): "upper"}


@dataclass(frozen=True)
class InfraredPair:
    """A rectified pair of images, and the depth that the camera tells for the left one."""

    left: Image
    """Grey levels of 8 bits, or of 10 bits in 16."""
    right: Image
    """The same of the right camera."""
    depth: Float[np.ndarray, "h w"]
    """Depth along the optical axis in metres, NaN where there is none; the left image's pixels."""
    focal: float
    """Focal length in pixels."""
    baseline: float
    """Metres between the two cameras."""

    def __post_init__(self) -> None:
        if not (self.focal > 0 and 0 < self.baseline < math.inf):
            raise InputError(f"baseline {self.baseline:g}: must be metres above 0")
        if not np.isfinite(self.depth).any():
            raise InputError("pair: the depth image holds no depth at all")
        middle = np.nanmedian(self.disparity)
        if not 0.5 < middle < self.left.shape[1] / 2:
            raise InputError(
                f"pair: f·b/z is {middle:.3g} px at the middle depth of "
                f"{np.nanmedian(self.depth):.3g} m; baseline is in metres, and --depth-scale tells "
                "the metres a step of the depth image"
            )

    @property
    def disparity(self) -> Float[np.ndarray, "h w"]:
        """The camera's own depth as disparity f·b/z in pixels."""
        return self.focal * self.baseline / self.depth.astype(np.float64)


@dataclass(frozen=True)
class Edges:
    """Pixels on the rims of surfaces before others, where the left image shows an edge."""

    place: Float[np.ndarray, "n 2"]
    """Column and row of the edge in the image."""
    outward: Int[np.ndarray, "n 2"]
    """Along columns or rows, from the near surface to the far one."""
    level: Float[np.ndarray, "n"]
    """Disparity half way between both."""
    cosine: Float[np.ndarray, "n"]
    """Of the angle between ``outward`` and the edge's normal."""


@dataclass(frozen=True)
class Comparison:
    """What our matcher makes of a pair, beside what the camera made of it."""

    disparity: Float[np.ndarray, "h w"]
    """Ours, NaN where there is none."""
    edges: Edges
    """Where the images show edges."""
    spill: dict[str, Float[np.ndarray, "n"]]
    """Pixels by which ``ours`` and the ``camera``'s surface reach beyond each of them."""
    matching: MatchingSettings
    """The matcher, with the search range that this depth needs."""
    figures: dict[str, Any]
    """Plain values, None where there is nothing to measure; `docs/realism.md` tells them."""


def compare(pair: InfraredPair, settings: MatchingSettings) -> Comparison:
    """Match a real pair and measure the result beside the camera's own depth.

    Raises:
        InputError: where the images are too small for the search range, or the matcher does not
            take them.
    """
    camera = pair.disparity
    settings = search_range(pair, settings)
    ours = match(pair.left, pair.right, settings).astype(np.float64)
    seen, theirs = np.isfinite(ours), np.isfinite(camera)
    both = in_sight(camera)
    common = both & seen & theirs
    difference = (ours - camera)[common]
    off = np.abs(difference)
    scale = float(np.median(ours[common] / camera[common])) if off.size else None
    edges = find_edges(pair.left, camera)
    spills = {"ours": spill(ours, edges), "camera": spill(camera, edges)}
    patches = planar_patches(camera)
    (rms, along), (camera_rms, camera_along) = (plane_noise(m, patches) for m in (ours, camera))
    notes = []
    if not off.size or np.median(off) > _OFF:
        notes.append(
            "most disparities are more than 3 px off the camera's: are LEFT and RIGHT swapped, or "
            "focal length, baseline or depth scale another camera's?"
        )
    elif scale is not None and abs(scale - 1) > _SCALE:
        notes.append(
            f"our disparities are {scale:.3f} times the camera's: is the focal length or baseline "
            "another camera's?"
        )
    if len(edges.level) < _FEWEST:
        notes.append(
            f"{len(edges.level)} pixels of edges that depth and image both show, fewer than "
            f"{_FEWEST}: no spill"
        )
    if not patches:
        notes.append(f"no plane of {PATCH[0]} × {PATCH[1]} px in the camera's depth: no noise")
    figures = {
        "valid": _share(seen, both),
        "camera_valid": _share(theirs, both),
        "holes": _share(theirs & ~seen, both),
        "camera_holes": _share(seen & ~theirs, both),
        "median_abs_px": plain(np.median(off)) if off.size else None,
        "difference_px": plain(np.median(difference)) if off.size else None,
        "scale": scale,
        "over_1px": _share(off > 1),
        "over_3px": _share(off > _OFF),
        "edge_spill_px": _spread(spills["ours"], edges),
        "camera_edge_spill_px": _spread(spills["camera"], edges),
        "edge_pixels": len(edges.level),
        "plane_rms_px": plain(rms),
        "camera_plane_rms_px": plain(camera_rms),
        "autocorrelation": plain(along),
        "camera_autocorrelation": plain(camera_along),
        "planes": len(patches),
        "notes": notes,
    }
    return Comparison(ours, edges, spills, settings, figures)


def search_range(pair: InfraredPair, settings: MatchingSettings) -> MatchingSettings:
    """The settings with as many disparities as the nearest depth needs, a few strays aside."""
    needed = float(np.nanquantile(pair.disparity, 0.999)) + settings.block_size
    room = min(1024, pair.left.shape[1] - settings.block_size) // 16 * 16
    wanted = max(settings.num_disparities, min(16 * math.ceil(needed / 16), room))
    return dataclasses.replace(settings, num_disparities=wanted)


def in_sight(camera: Float[np.ndarray, "h w"]) -> Bool[np.ndarray, "h w"]:
    """Pixels whose match lies within the right image: the left band of f·b/z columns does not.

    Where there is no disparity, that of the next pixel to the right that has one is taken.

    Example:
        >>> in_sight(np.array([[np.nan, np.nan, 2.0, np.nan]])).tolist()
        [[False, False, True, True]]
    """
    following = _following(camera)
    columns = np.arange(camera.shape[1])
    nearest = np.take_along_axis(camera, np.minimum(following, columns[-1]), axis=1)
    return np.where(following <= columns[-1], columns >= nearest, columns >= np.nanmedian(camera))


def _following(disparity: Float[np.ndarray, "h w"]) -> Int[np.ndarray, "h w"]:
    """Column of the first pixel at or right of each that has a disparity; the width if none has."""
    width = disparity.shape[1]
    columns = np.where(np.isfinite(disparity), np.arange(width), width)
    return np.minimum.accumulate(columns[:, ::-1], axis=1)[:, ::-1]


def find_edges(image: Image, camera: Float[np.ndarray, "h w"]) -> Edges:
    """Find where the image shows the rims of what stands before something else.

    Args:
        image: The left image.
        camera: Disparity that tells where surfaces end, within a few pixels.

    Returns:
        An edge for each pixel at which the rims are met along rows or columns, at 45° or less to
        their normal. Left out is what has no straight rim, a step below 4 px, another near surface
        within 20 px, or no edge in the image that stands out along all of the line.
    """
    grey = image.astype(np.float64) * (255 / (255 if image.dtype == np.uint8 else 1023))
    rows, columns = np.indices(camera.shape)
    edges: list[tuple[float, ...]] = []
    for turns in range(4):  # each side in turn becomes the right one
        u, v = np.rot90(columns, turns), np.rot90(rows, turns)
        for y, x, level, slope, shift in _rims(np.rot90(grey, turns), np.rot90(camera, turns)):
            du, dv = u[y, x + 1] - u[y, x], v[y, x + 1] - v[y, x]
            place = (u[y, x] + du * shift, v[y, x] + dv * shift)
            edges.append((*place, du, dv, level, 1 / math.hypot(1, slope)))
    table = np.array(edges, dtype=np.float64).reshape(-1, 6)
    return Edges(table[:, :2], table[:, 2:4].astype(int), table[:, 4], table[:, 5])


def _rims(
    grey: Float[np.ndarray, "h w"], camera: Float[np.ndarray, "h w"]
) -> list[tuple[int, int, float, float, float]]:
    """Right rims: row and column of the step, level, slope dx/dy, and how far off the edge is."""
    from scipy.ndimage import map_coordinates

    level, steps = _steps(camera)
    height, width = camera.shape
    margin, reach = _OUTSIDE, _ALONG + 2
    along, across = np.arange(-_ALONG, _ALONG + 1), np.arange(-_ACROSS, _ACROSS + 1)
    rims = []
    for y, x in np.argwhere(steps).tolist():
        if not (margin <= x < width - margin and margin <= y < height - margin):
            continue
        beyond = camera[y, x + 1 : x + 1 + _OUTSIDE]
        if (beyond > level[y, x]).any():  # another surface, or a stray: where ours ends is moot
            continue
        around = steps[y - _ALONG : y + _ALONG + 1, x - reach : x + reach + 1]
        down, right = np.argwhere(around).T - np.array([[_ALONG], [reach]])
        slope, start = 0.0, 0.0
        for most in (np.inf, 3.0, 1.5):
            near = np.abs(right - start - slope * down) <= most
            if len({*down[near].tolist()}) < 0.7 * len(along):
                break
            slope, start = np.polyfit(down[near], right[near], 1)
        else:
            if abs(slope) > 1 or abs(start) > 1.5:
                continue
            place = (x + start + slope * along)[:, None] + np.arange(-_ACROSS - 1, _ACROSS + 2)
            lines = np.broadcast_to((y + along)[:, None], place.shape)
            lines = map_coordinates(grey, [lines, place], order=1)
            profiles = np.stack([np.median(part, axis=0) for part in np.array_split(lines, 3)])
            rise = (profiles[:, 2:] - profiles[:, :-2]) / 2
            change = np.where(np.abs(np.sign(rise).sum(axis=0)) == 3, np.abs(rise).min(axis=0), 0)
            peak = int(np.argmax(change * np.exp(-((across / _NEARNESS) ** 2) / 2)))
            if change[peak] < max(1.0, _CONTRAST * np.median(np.abs(rise))):
                continue
            top = slice(max(0, peak - 2), peak + 3)
            shift = start + float(np.average(across[top], weights=change[top]))
            rims.append((y, x, float(level[y, x]), float(slope), shift))
    return rims


def _steps(
    camera: Float[np.ndarray, "h w"],
) -> tuple[Float[np.ndarray, "h w"], Bool[np.ndarray, "h w"]]:
    """Last pixels of surfaces before a farther one to the right, and the disparity half way.

    Between both may be a gap as wide as the step, where only the left camera sees the far one.
    """
    width = camera.shape[1]
    columns = np.arange(width)
    following = _following(camera)[:, np.minimum(columns + _LAG, width - 1)]
    far = np.take_along_axis(camera, np.minimum(following, width - 1), axis=1)
    near = np.roll(camera, _LAG, axis=1)
    step, level = near - far, (near + far) / 2
    last = (camera > level) & ~(np.roll(camera, -1, axis=1) > level)
    close = following - columns <= step + 4 * _LAG
    return level, last & close & (step >= _STEP)


def spill(disparity: Float[np.ndarray, "h w"], edges: Edges) -> Float[np.ndarray, "n"]:
    """Pixels, along the normal, by which the near surface reaches beyond each edge.

    It ends where that parts near pixels within from far ones without best; NaN where less than
    half of what lies within has a disparity.
    """
    across = np.arange(-_INSIDE, _OUTSIDE + 1)
    middle = np.rint(edges.place).astype(int)
    columns, rows = (middle[:, None] + across[:, None] * edges.outward[:, None]).transpose(2, 0, 1)
    height, width = disparity.shape
    part = disparity[rows.clip(0, height - 1), columns.clip(0, width - 1)]
    sides = np.where(np.isfinite(part), np.where(part > edges.level[:, None], 1, -1), 0)
    last = across[np.cumsum(sides, axis=1).argmax(axis=1)]
    rest = ((middle - edges.place) * edges.outward).sum(axis=1)
    is_filled = np.isfinite(part[:, :_INSIDE]).mean(axis=1) >= 0.5
    return np.where(is_filled, (last + 0.5 + rest) * edges.cosine, np.nan)


def _spread(spills: Float[np.ndarray, "n"], edges: Edges) -> dict[str, float | None]:
    """Median, p10 and p90 of all edges, and the median of those on each side of what is near."""

    def quantile(values: np.ndarray, q: float) -> float | None:
        values = values[np.isfinite(values)]
        return float(np.quantile(values, q)) if len(values) >= _FEWEST else None

    named = {"median": 0.5, "p10": 0.1, "p90": 0.9}
    sides = {
        name: quantile(spills[(edges.outward == side).all(axis=1)], 0.5)
        for side, name in _SIDES.items()
    }
    return {name: quantile(spills, q) for name, q in named.items()} | sides


def planar_patches(camera: Float[np.ndarray, "h w"]) -> list[tuple[int, int]]:
    """First column and row of patches in which 95 % of the pixels lie within 0.5 px of a plane."""
    wide, high = PATCH
    return [
        (x, y)
        for y in range(0, camera.shape[0] - high + 1, high // 2)
        for x in range(0, camera.shape[1] - wide + 1, wide // 2)
        if (np.abs(_off_plane(camera[y : y + high, x : x + wide])) < _FLAT).mean() >= 0.95
    ]


def plane_noise(
    disparity: Float[np.ndarray, "h w"], patches: Sequence[tuple[int, int]]
) -> tuple[float, Float[np.ndarray, "3"]]:
    """RMS in pixels about the planes of patches, and autocorrelation along x at `LAGS`; medians.

    Matches 1 px off their plane and more are left out, and patches of which they leave less than
    half; NaN where none is left.

    Args:
        disparity: Disparity in pixels, NaN where there is none.
        patches: First column and row of each.
    """
    figures = []
    for x, y in patches:
        rest = _off_plane(disparity[y : y + PATCH[1], x : x + PATCH[0]])
        rest = np.where(np.abs(rest) < 1, rest, np.nan)
        if np.isfinite(rest).mean() < 0.5:
            continue
        rest = rest - np.nanmean(rest)
        power = np.nanmean(rest**2)
        pairs = (rest[:, lag:] * rest[:, :-lag] for lag in LAGS)
        figures.append([math.sqrt(power), *(np.nanmean(p) / max(power, 1e-12) for p in pairs)])
    rms, *along = np.median(figures, axis=0) if figures else np.full(1 + len(LAGS), np.nan)
    return float(rms), np.array(along)


def _off_plane(part: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "h w"]:
    """Residuals of a plane in disparity, which a plane in space is, fitted to what is near it."""
    v, u = np.mgrid[: part.shape[0], : part.shape[1]]
    design = np.stack([u, v, np.ones_like(u)], axis=-1).astype(np.float64)
    kept, rest = np.isfinite(part), np.full(part.shape, np.nan)
    for _ in range(3):
        if kept.mean() < 0.5:
            break
        rest = part - design @ np.linalg.lstsq(design[kept], part[kept], rcond=None)[0]
        kept = np.abs(rest) < 1
    return rest


def _share(chosen: Bool[np.ndarray, "..."], among: Any = True) -> float | None:
    count = int(np.broadcast_to(among, chosen.shape).sum())
    return float((chosen & among).sum() / count) if count else None
