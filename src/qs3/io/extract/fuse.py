"""Fusing the raw depth points of many frames in bounded memory, their noise left as it is.

A volume or a mean per voxel would average the sensor's noise away, which is what clouds of raw
depth are for. Here every point that comes out is one that the sensor measured. Where there are too
many, chance decides: each point and each voxel has a number hashed from the seed and its place
(frame and pixel, or voxel), and the lowest numbers stay. The result is a uniform choice that
depends neither on the order of the frames nor on how the work was cut up.
"""

import numpy as np
from jaxtyping import Float, Float32, Int, UInt64

from qs3.errors import InputError

_MASK = 2**64 - 1
_REACH = 2**20

_Part = tuple[Float32[np.ndarray, "_ 3"], UInt64[np.ndarray, "_"]]


def mix(values: UInt64[np.ndarray, "n"], seed: int) -> UInt64[np.ndarray, "n"]:
    """Hash numbers to 64 bits that look random: SplitMix64's finaliser, twice.

    Source: Steele, Lea and Flood, "Fast splittable pseudorandom number generators", OOPSLA 2014.

    Example:
        >>> mix(np.arange(2, dtype=np.uint64), 0).tolist() == mix(
        ...     np.arange(2, dtype=np.uint64), 1
        ... ).tolist()
        False
    """
    mixed = _finalise(np.array([seed & _MASK], dtype=np.uint64))
    return _finalise(_finalise(values) ^ mixed)


def _finalise(values: UInt64[np.ndarray, "n"]) -> UInt64[np.ndarray, "n"]:
    z = values + np.uint64(0x9E3779B97F4A7C15)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


def subsample(
    points: Float[np.ndarray, "n 3"],
    keys: UInt64[np.ndarray, "n"],
    voxel: float,
    max_points: int,
    seed: int,
) -> Int[np.ndarray, "m"]:
    """Indices, rising, of one point a voxel, and of at most ``max_points`` voxels.

    In each voxel the point of the lowest key stays; of too many voxels those stay whose hash is
    lowest. Parts first and their union then gives what everything at once gives.

    Args:
        points: The cloud.
        keys: Random number of each point.
        voxel: Edge of a voxel, in the units of the points.
        max_points: Largest size of the result.
        seed: Seed of the voxels' hashes.

    Raises:
        InputError: If a point lies a million voxels from the origin.

    Example:
        >>> cloud = np.array([[0.001, 0, 0], [0.002, 0, 0], [0.5, 0, 0]])
        >>> subsample(cloud, np.array([9, 3, 7], dtype=np.uint64), 0.01, 10, seed=0).tolist()
        [1, 2]
    """
    # Divided as float64: the voxel of a point must not depend on the array it lies in.
    cells = np.floor(points.astype(np.float64) / voxel)
    if not (np.abs(cells) < _REACH).all():
        raise InputError(f"points lie more than {_REACH} voxels of {voxel} from the origin")
    x, y, z = (cells + _REACH).astype(np.uint64).T
    codes = (x << np.uint64(42)) | (y << np.uint64(21)) | z
    order = np.lexsort((keys, codes))
    ordered = codes[order]
    first = np.ones(len(order), dtype=bool)
    first[1:] = ordered[1:] != ordered[:-1]
    kept = order[first]
    if len(kept) > max_points:
        lowest = np.argsort(mix(codes[kept], seed), kind="stable")[:max_points]
        kept = kept[lowest]
    return np.sort(kept)


class ObjectFusion:
    """Gathers the raw points of one object from a stream of frames.

    Of the frames that are offered, at most ``max_frames`` stay, chosen uniformly by the hash of
    their number. Each is subsampled by itself, so that at most ``max_frames`` × ``max_points``
    points are held. With ``max_frames`` 0 all frames stay.
    """

    def __init__(self, voxel: float, max_points: int, max_frames: int, seed: int) -> None:
        self._voxel, self._max_points = voxel, max_points
        self._max_frames, self._seed = max_frames, seed
        self._held: dict[int, tuple[int, int, _Part]] = {}  # rank, points and part of each frame
        self.offered = 0
        """Frames offered so far."""

    @property
    def frames(self) -> int:
        """Frames fused."""
        return len(self._held)

    @property
    def measured(self) -> int:
        """Points in the fused frames, before sampling."""
        return sum(count for _, count, _ in self._held.values())

    def add(
        self, frame: int, points: Float32[np.ndarray, "n 3"], pixels: Int[np.ndarray, "n"]
    ) -> None:
        """Offer the points of one frame, each frame once.

        The number of the frame and those of the points' pixels are below 2³².
        """
        self.offered += 1
        rank = int(mix(np.array([frame], dtype=np.uint64), self._seed + 1)[0])
        if self._max_frames and len(self._held) == self._max_frames:
            last = max(self._held, key=lambda number: self._held[number][0])
            if rank >= self._held[last][0]:
                return
            del self._held[last]
        place = np.uint64(frame << 32) | pixels.astype(np.uint64)
        part = self._kept(points, mix(place, self._seed))
        self._held[frame] = (rank, len(points), part)

    def points(self) -> Float32[np.ndarray, "n 3"]:
        """Return the cloud: at most ``max_points`` measured points, frame after frame."""
        parts = [self._held[frame][2] for frame in sorted(self._held)]
        if not parts:
            return np.zeros((0, 3), dtype=np.float32)
        points, keys = map(np.concatenate, zip(*parts, strict=True))
        return self._kept(points, keys)[0]

    def _kept(self, points: Float32[np.ndarray, "n 3"], keys: UInt64[np.ndarray, "n"]) -> _Part:
        kept = subsample(points, keys, self._voxel, self._max_points, self._seed)
        return points[kept], keys[kept]
