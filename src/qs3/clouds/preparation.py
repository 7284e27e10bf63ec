"""Preprocessing shared by training and inference: outliers, number of points, unit ball.

Networks use all of it; what a forest and the comparison with CAD see is
`qs3.parts.loaded_forest.cleaned`.

Every function returns new float32 arrays and leaves its input as it was.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Float32, Int

from qs3.errors import InputError, UnevenSizesError, say_once
from qs3.points import sampling

MOST_POINTS = 1_000_000
"""Largest number of points of one cloud."""
BLOCK = 256
"""Clouds processed together, to bound memory."""


@dataclass(frozen=True)
class Preparation:
    """Settings of the preprocessing; the defaults are the paper's."""

    remove_outliers: bool = False
    """Remove outliers (`qs3.points.outliers.inliers`) and repeated points first."""
    radius_share: float = 1.0
    """Share of the points within radius 1. At 1 this is the unit ball: mean and farthest point;
    below, the coordinate-wise median and a quantile of the distances."""
    redraw: bool = False
    """Train on other random points of each cloud in each epoch; scores and predictions use the
    farthest point sample."""
    size_input: bool = False
    """Give the network the size of a cloud (`qs3.models.wrappers.Sized`), for data in metres of
    objects with real sizes."""
    metric_unit: float | None = None
    """Length in metres that becomes 1, in place of each cloud's radius: about half of a part.
    Networks of few known parts in metres learn their size best this way. Excludes `size_input`."""
    align: bool = False
    """Turn clouds to their main horizontal axis (`qs3.models.wrappers.Aligned`)."""

    def __post_init__(self) -> None:
        if not 0.5 <= self.radius_share <= 1:
            raise InputError(f"setting radius_share = {self.radius_share} must be in 0.5 to 1")
        if self.metric_unit is not None and not 0 < self.metric_unit < math.inf:
            raise InputError(f"setting metric_unit = {self.metric_unit} must be above 0")
        if self.metric_unit is not None and self.size_input:
            raise InputError("setting metric_unit keeps the size already; leave size_input out")

    @property
    def in_metres(self) -> bool:
        """Whether the size of a cloud matters."""
        return self.size_input or self.metric_unit is not None

    @property
    def counts_points(self) -> bool:
        """Whether outliers or repeated points of a cloud matter."""
        return self.remove_outliers or self.redraw


PAPER = Preparation()
"""The paper's preparation."""
ROBUST = Preparation(remove_outliers=True, radius_share=0.95, redraw=True)
"""The default of ``qs3 train``, robust against stray points."""


def single(points: np.ndarray, where: str = "") -> Float32[np.ndarray, "n 3"]:
    """Return points in single precision; ``where`` begins messages, such as ``"cloud 3 "``.

    Points far from the origin are moved, see `near_origin`.

    Example:
        >>> single(np.array([[5403210.0, 0, 0], [5403210.25, 0, 0]])).tolist()
        [[0.0, 0.0, 0.0], [0.25, 0.0, 0.0]]
    """
    return near_origin(points, where)[0]


def near_origin(
    points: np.ndarray, where: str = ""
) -> tuple[Float32[np.ndarray, "n 3"], Float[np.ndarray, "3"]]:
    """Return points in single precision as `single`, and what was taken from them, in metres.

    An axis is shifted by whole metres, with a warning, if rounding would move a point by 1/10,000
    of the cloud's size.
    """
    with np.errstate(over="ignore"):  # a number beyond float32 is refused as not finite
        plain = np.ascontiguousarray(points, dtype=np.float32)
    if not len(plain):
        raise InputError(f"{where}holds no point")
    low, high = points.min(axis=0), points.max(axis=0)
    if not np.isfinite(plain).all():
        raise InputError(
            f"{where}has a point that is not finite; remove points with NaN or infinity"
        )
    size = float((np.asarray(high, np.float64) - low).max())
    steps = np.finfo(np.float32).eps * np.maximum(np.abs(low), np.abs(high)).astype(np.float64)
    far = steps > 1e-4 * size
    if not far.any() or not size:
        return plain, np.zeros(3)
    if points.dtype == np.float32 or (points == plain).all():
        if steps.max() > 1e-2 * size:
            raise InputError(
                f"{where}lies so far from the origin that single precision rounds it to "
                f"{steps.max():.2g} m; export it in double precision, or move it first"
            )
        return plain, np.zeros(3)
    shift = np.where(far, np.round((low + high) / 2), 0.0)
    moved = " ".join(f"{0 - value:.0f}" for value in shift)
    say_once(f"{where}lies far from the origin and is moved by {moved} (said once)", "moved")
    return (points - shift).astype(np.float32), shift


_UNSEEN, _HEAP = 0.01, 0.1  # share of a cloud's points at a place of equal coordinates, at any
_LARGEST = np.finfo(np.float32).max  # some write it for infinity


def measured(points: Float[np.ndarray, "n 3"], where: str = "") -> Float[np.ndarray, "m 3"]:
    """Drop, with a warning, what marks a pixel without a measurement: NaN, infinity, (0, 0, 0).

    Points at (0, 0, 0), (-1, -1, -1) or another place of equal coordinates are dropped if they are
    twice as many as at other places, and 1 % of all or ten times as many; those at any one place,
    where a transform has put (0, 0, 0), if they are a tenth of all and ten times as many. A cloud
    of these alone keeps them. A cloud without any measurement is an error.

    Example:
        >>> measured(np.array([[1.0, 0, 0], [np.nan, 0, 0]])).tolist()
        [[1.0, 0.0, 0.0]]
    """
    finite = np.isfinite(points).all(axis=1)
    if points.dtype.itemsize > 2:
        finite &= (np.abs(points) != _LARGEST).all(axis=1)
    marks = [(~finite, "NaN or infinite")]
    equal = finite & (points == points[:, :1]).all(axis=1)
    values, counts = np.unique(points[equal, 0], return_counts=True)
    usual, place, times = 1.0, np.zeros(3), 0
    if (counts > 1).any() or _has_heap(points[finite]):
        usual, place, times = _places(points[finite])
    if max(_HEAP * len(points), 10 * usual) <= times < finite.sum() and (place != place[0]).any():
        at = (points == place).all(axis=1)
        marks.append((at, "at ({:g}, {:g}, {:g})".format(*place)))
    for value, count in zip(values, counts, strict=True):
        is_often = count >= min(_UNSEEN * len(points), 10 * usual)
        if 2 * usual <= count < finite.sum() and is_often:
            at = equal & (points[:, 0] == value)
            marks.append((at, f"at ({value:g}, {value:g}, {value:g})"))
    for marked, what in marks:
        if marked.any():
            if marked.all():
                raise InputError(f"{where}holds no point that is finite")
            say_once(
                f"{where}{marked.sum()} of {len(points)} points are {what}, which marks a pixel "
                "without a measurement or fills a cloud up, and are dropped (said once)",
                f"{what} points",
            )
    dropped = np.logical_or.reduce([marked for marked, _ in marks])
    return points[~dropped] if dropped.any() and not dropped.all() else points


def _has_heap(points: Float[np.ndarray, "n 3"]) -> bool:
    """Whether a tenth of the points may lie at one place: they share an x, a y and a z."""
    times = max(1, int(_HEAP * len(points)))
    columns = (np.sort(column) for column in points.T)
    return all((column[times:] == column[:-times]).any() for column in columns)


def _places(points: Float[np.ndarray, "n 3"]) -> tuple[float, Float[np.ndarray, "3"], int]:
    """Return the median number of points at one place, the place of most points, and their number.

    The median is above 1 if meshes or samples repeat.
    """
    ordered = points[np.lexsort(points.T)]
    starts = np.flatnonzero(np.append(True, (ordered[1:] != ordered[:-1]).any(axis=1)))
    counts = np.diff(starts, append=len(points))
    return float(np.median(counts)), ordered[starts[counts.argmax()]], int(counts.max())


def unit_ball(points: Float[np.ndarray, "b n 3"]) -> Float[np.ndarray, "b n 3"]:
    """Centre each cloud on its mean and divide by its farthest distance from there."""
    return normalise(points, PAPER)


def normalise(
    points: Float[np.ndarray, "b n 3"], preparation: Preparation
) -> Float[np.ndarray, "b n 3"]:
    """Centre each cloud and divide it by its radius, both as ``radius_share`` has them.

    With ``size_input`` clouds are only centred; with ``metric_unit`` all are divided by that. A
    cloud becomes zeros if so many of its points are equal that the radius is zero.

    Example:
        >>> normalise(np.array([[[0.0, 0, 0], [4, 0, 0]]]), PAPER).tolist()
        [[[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]]]
    """
    balls = np.empty(points.shape, dtype=np.float32)
    for start in range(0, len(points), BLOCK):  # in double precision, but never all at once
        balls[start : start + BLOCK] = _normalised(points[start : start + BLOCK], preparation)
    return balls


def _normalised(
    points: Float[np.ndarray, "b n 3"], preparation: Preparation
) -> Float[np.ndarray, "b n 3"]:
    share = preparation.radius_share
    if share == 1:
        centre = points.mean(axis=1, keepdims=True, dtype=np.float64)
    else:
        centre = np.median(points.astype(np.float64), axis=1, keepdims=True)
    centred = points - centre
    distance = np.linalg.norm(centred, axis=2)
    if share == 1:
        radius = distance.max(axis=1, initial=0.0)[:, None, None]
    else:
        rank = radius_rank(share, points.shape[1])
        radius = np.partition(distance, rank, axis=1)[:, rank, None, None]
    # Equal points can miss their own mean by a rounding error, which must not be blown up.
    extent = np.abs(points).max(axis=(1, 2), initial=0.0)[:, None, None]
    flat = radius <= 1e-12 * extent
    if preparation.in_metres:
        return np.where(flat, 0.0, centred / (preparation.metric_unit or 1.0))
    return np.where(flat, 0.0, centred / np.where(flat, 1.0, radius))


def radius_rank(share: float, count: int) -> int:
    """Rank, from 0, of the least of ``count`` distances that a share does not exceed."""
    return max(0, math.ceil(share * count) - 1)


LARGEST = 4096
"""Points of a cloud that count at most, or the network's number if that is larger."""


def thin(count: int, most: int) -> Int[np.ndarray, "k"]:
    """Return indices of at most ``most`` of a cloud's points, in order; each call draws alike."""
    if count <= most:
        return np.arange(count)
    return np.sort(np.random.default_rng(0).permutation(count)[:most])


def distinct_inliers(
    cloud: Float[np.ndarray, "n 3"], remove_outliers: bool, most: int = LARGEST
) -> Int[np.ndarray, "k"]:
    """Return indices of the points that count: each place once, without outliers if wanted."""
    from qs3.points.outliers import inliers

    kept = thin(len(cloud), most)
    order = np.lexsort(cloud[kept].T)  # a fifth of the time of np.unique
    ordered = cloud[kept[order]]
    first = np.append(True, (ordered[1:] != ordered[:-1]).any(axis=1))
    kept = kept[np.sort(order[first[: len(order)]])]
    return kept[inliers(cloud[kept])] if remove_outliers else kept


def resample(cloud: Float[np.ndarray, "n 3"], num_points: int) -> Float[np.ndarray, "m 3"]:
    """Bring one cloud to ``num_points``: a farthest point sample, or its points repeated in order.

    The first point of the sample is point 0.

    Example:
        >>> resample(np.array([[0.0, 0, 0], [1, 0, 0]]), 3)[:, 0].tolist()
        [0.0, 1.0, 0.0]
    """
    if not 1 <= num_points <= MOST_POINTS:
        raise InputError(f"num_points must be in 1 to {MOST_POINTS}, not {num_points}")
    return single(cloud[sampling.resample(cloud, num_points)])


def stack(
    clouds: Sequence[Float[np.ndarray, "_ 3"]],
    num_points: int | None,
    where: str,
    most: int | None = None,
) -> Float[np.ndarray, "b n 3"]:
    """Put clouds into one array of ``num_points`` each, by `resample`.

    If ``num_points`` is None, clouds of several sizes are refused, or brought to the size of the
    largest, at most ``most``: smaller ones by repeats in order, larger ones by `thin`. ``where``
    names the source in messages.
    """
    if not clouds:
        raise InputError(f"{where}: no cloud found")
    sizes = {len(cloud) for cloud in clouds}
    if num_points is not None and sizes != {num_points}:
        clouds = [resample(cloud, num_points) for cloud in clouds]
    elif num_points is None and len(sizes) > 1:
        if most is None:
            raise UnevenSizesError(
                f"{where}: clouds have {min(sizes)} to {max(sizes)} points; name one number for all"
            )
        if 0 in sizes:
            raise InputError(f"{where}: holds an empty cloud")
        points = np.empty((len(clouds), min(most, max(sizes)), 3), dtype=np.float32)
        for row, cloud in enumerate(clouds):
            kept = thin(len(cloud), most)
            points[row] = single(cloud)[kept[np.arange(points.shape[1]) % len(kept)]]
        return points
    return np.stack([single(cloud) for cloud in clouds])
