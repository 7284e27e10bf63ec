"""Hypotheses for a cluster of several parts: votes, alignment, and the picture's verdict."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Int32

from qs3.geometry import invert_rigid, rigid, transform_points
from qs3.objects.cut import pixels_of
from qs3.parts.align import HELD, align
from qs3.parts.library import Library
from qs3.parts.scenes.lying import lying
from qs3.parts.scenes.normals import normals_of
from qs3.parts.scenes.picture import Picture
from qs3.parts.scenes.verifying import Hypothesis, verify
from qs3.parts.scenes.voting import PEAKS, pairs_of, propose
from qs3.parts.views import Part
from qs3.parts.visible import axis_turn, visible

_REFERENCES, _PAIRED = 40, 700
"""Points of a cluster that vote, and points that they make pairs with."""
_USED = 20_000
"""Points of a cluster, at most."""
_LAIN, _SETTLED = 24, 4
"""Poses of each part that lies that are verified as voted, and poses that are aligned."""
_FEWEST, _FEWEST_PAIRS = 30, 12
"""Points of a cluster that is searched, and points that are aligned, at least."""
_VERIFIED, _ALIGNED, _AMONG = 80, 10, 3
"""Poses of each part that are verified as voted, and poses that are aligned: so many times as many
if the library has one CAD file."""
_SURFACE, _TIMES = 2.5, 12
"""Squared diameters of a part that a heap of several shows, and most heaps in a cluster."""
_STAGES = ((0.08, 0.04), 160), ((0.04, 0.015), 300)
"""Widths of the kernel in diameters at the first and last step, and points, of each alignment."""
_AGREED = 0.2
"""Least agreement of a pose that is kept."""
_HOPELESS, _GOOD, _AGAIN, _GAIN = 0.4, 0.92, 3, 0.02
"""Agreements between which a pose is aligned further, the most times that it is, and the value, by
its area, that it must gain each time. Of 40 heaps of three sets of parts (scenes 20 to 59 of
benchmarks/scenes.py) 82, 84 and 72 % of the parts are found, in place of 82, 81 and 70."""
_NUDGED = np.radians(8.0), 0.04
"""Radians, and diameters, by which a pose is moved before it is aligned anew."""
_SAME_TURN, _SAME_SHIFT = np.cos(np.radians(15)), 0.1
"""Poses that count as one: cosine of the turn between them, and shift in diameters."""


@dataclass(frozen=True, eq=False)
class Cluster:
    """Points of a picture that some parts should explain."""

    picture: Picture
    points: Float32[np.ndarray, "n 3"]
    """Camera's axes, in random order."""
    normals: Float32[np.ndarray, "n 3"]
    spacing: float
    noise: float
    """Metres: standard deviation of the points."""

    @classmethod
    def of(cls, picture: Picture, mask: Bool[np.ndarray, "h w"]) -> "Cluster":
        """Return the pixels of a mask that have a normal; of a large mask, as many as are used."""
        pixels = np.flatnonzero(mask & np.isfinite(picture.depth)).astype(np.int32)
        total = len(pixels)
        if total > _USED:
            pixels = np.sort(np.random.default_rng(0).choice(pixels, _USED, replace=False))
        normals = normals_of(picture, pixels)
        few = np.zeros_like(mask)
        few.flat[pixels] = True
        points = picture.points(few).astype(np.float32)
        good = np.isfinite(normals).all(axis=1)
        order = np.random.default_rng(0).permutation(int(good.sum()))
        away = float(np.median(points[:, 2])) if len(points) else 1.0
        points, normals = points[good][order], normals[good][order]
        spacing = away / picture.camera.fx * np.sqrt(total / max(len(pixels), 1))
        return cls(picture, points, normals, float(spacing), picture.noise * away**2)


def propose_all(library: Library, cluster: Cluster) -> list[Hypothesis]:
    """Return aligned and verified hypotheses of all parts for a cluster."""
    if len(cluster.points) < _FEWEST:
        return []
    found, few = [], int(_ALIGNED * max(1.0, _AMONG / len(library.parts)))
    for part in library:
        found += _proposed(part, cluster, few)
    return found


def _times(part: Part, cluster: Cluster) -> float:
    """Return how many times as many points and poses a large cluster needs, as it holds more parts.

    The points near each, and the poses of each, stay as many.
    """
    surface = len(cluster.points) * cluster.spacing**2 / part.diameter**2
    return float(np.clip(surface / _SURFACE, 1, _TIMES))


def _proposed(part: Part, cluster: Cluster, aligned: int) -> list[Hypothesis]:
    times = _times(part, cluster)
    paired = int(times * _PAIRED)
    few = cluster.points[:paired], cluster.normals[:paired]
    references = np.arange(min(int(times * _REFERENCES), len(few[0])), dtype=np.int32)
    turns, shifts, votes = propose(pairs_of(part), *few, references, part.diameter)
    # Of all votes, those for a part that is seen well would leave none to its neighbours.
    peak = np.arange(len(votes)) % PEAKS
    best = np.lexsort((-votes, peak))[: int(times * _VERIFIED)]
    return _judged(part, cluster, turns[best], shifts[best], int(times * aligned))


def lain_all(library: Library, cluster: Cluster) -> list[Hypothesis]:
    """Return aligned and verified hypotheses of all parts that lie on the table in a cluster."""
    way = cluster.picture.camera_from_table
    if len(cluster.points) < _FEWEST or way is None:
        return []
    found = []
    for part in library:
        if len(part.resting):
            times = _times(part, cluster)
            poses = lying(part, cluster.points, cluster.normals, way, cluster.noise,
                          int(times * _LAIN), times)  # fmt: skip
            found += _judged(part, cluster, *poses, int(times * _SETTLED), lies=True)
    return found


def _judged(
    part: Part,
    cluster: Cluster,
    turns: Float[np.ndarray, "h 3 3"],
    shifts: Float[np.ndarray, "h 3"],
    aligned: int,
    lies: bool = False,
) -> list[Hypothesis]:
    """Verify poses as they are, align the best, and return those that differ."""
    tried: list[Hypothesis] = []
    poses = np.tile(np.eye(4), (len(turns), 1, 1))
    poses[:, :3, :3], poses[:, :3, 3] = turns, shifts
    for pose in poses:
        if _is_new(pose, [h.pose for h in tried], part):
            tried.append(verify(cluster.picture, part, pose))
    tried.sort(key=lambda h: -h.value)
    kept: list[Hypothesis] = []
    taken: list[np.ndarray] = []
    equals = part.symmetry.equals(24)
    for hypothesis in tried:
        # What lies beside a pose that is aligned already would come to it, or to its equal.
        if not _is_new(hypothesis.pose, taken, part):
            continue
        if aligned == 0:
            break
        aligned -= 1
        better = settled(hypothesis, cluster, lies)
        for _ in range(_AGAIN):
            if not _HOPELESS < better.agreement < _GOOD:
                break
            before, better = better, settled(better, cluster)
            if better.value < before.value + _GAIN * before.area:
                break
        if better.agreement > _AGREED and _is_new(better.pose, taken, part):
            kept.append(better)
            taken += [*(better.pose @ equals)]
    return kept


def _is_new(
    pose: Float[np.ndarray, "4 4"], others: Sequence[Float[np.ndarray, "4 4"]], part: Part
) -> bool:
    if not others:
        return True
    known = np.array(others)
    traces = np.einsum("ij,kij->k", pose[:3, :3], known[:, :3, :3])
    shifts = np.einsum("kij,j->ki", pose[:3] - known[:, :3], np.append(part.middle, 1.0))
    near = np.linalg.norm(shifts, axis=1) < _SAME_SHIFT * part.diameter
    return not (near & (traces > 1 + 2 * _SAME_TURN)).any()


def settled(hypothesis: Hypothesis, cluster: Cluster, lies: bool = False) -> Hypothesis:
    """Align a part with the points around it, twice, and verify it again.

    A part that ``lies`` on the table stays there, and takes the last of the two alignments alone.
    """
    part, pose, picture = hypothesis.part, hypothesis.pose, cluster.picture
    tolerance = picture.tolerance(float(pose[2, 3]))
    from_table = picture.camera_from_table
    level = np.eye(3) if from_table is None else from_table[:3, :3].T
    for widths, count in _STAGES[lies:]:
        middle = pose[:3, :3] @ part.middle + pose[:3, 3]
        near = np.linalg.norm(cluster.points - middle, axis=1) < 0.55 * part.diameter
        rows = np.flatnonzero(near)[:count]
        if len(rows) < _FEWEST_PAIRS:
            return hypothesis
        scan_gap = cluster.spacing * np.sqrt(near.sum() / len(rows))
        wide, narrow = (max(width * part.diameter, tolerance * k)
                        for width, k in zip(widths, (1.5, 0.7), strict=True))  # fmt: skip
        seen = _shown(picture, part, pose, wide)
        order = np.random.default_rng(0).permutation(len(seen))[: 2 * count]
        points, normals = part.points[seen[order]], part.normals[seen[order]]
        turn = level @ pose[:3, :3]
        turned, shift, _ = align(
            ((cluster.points[rows] - middle) @ level.T).astype(np.float32),
            (cluster.normals[rows] @ level.T).astype(np.float32), points, normals, turn,
            level @ (pose[:3, 3] - middle), 6, wide, narrow, part.gap(len(seen), len(order)),
            scan_gap, (0.03 * part.diameter) ** 2, -hypothesis.low, HELD if lies else 0.0,
            -turn[2], np.zeros(3), 1.0, True,
        )  # fmt: skip
        pose = rigid(level.T @ turned, level.T @ shift + middle)
    better = verify(picture, part, pose)
    return better if better.value > hypothesis.value else hypothesis


def _shown(
    picture: Picture, part: Part, pose: Float[np.ndarray, "4 4"], margin: float
) -> Int32[np.ndarray, "k"]:
    """Return the points of a part that a camera sees, without those behind something else.

    Points are behind something if it is nearer by more than a margin, in metres. Those beyond the
    picture are kept. If fewer than 12 are left, all that the camera would see are returned.
    """
    rows = visible(part.points, part.spacing, invert_rigid(pose)[:3, 3], part.middle)
    posed = transform_points(pose, part.points[rows].astype(np.float64))
    places, (height, width) = pixels_of(posed, picture.camera), picture.depth.shape
    u, v = np.clip(np.rint(places), -1, (width, height)).astype(np.int64).T
    inside = (u >= 0) & (u < width) & (v >= 0) & (v < height)
    nearest = picture.depth[v.clip(0, height - 1), u.clip(0, width - 1)]
    kept = rows[~(inside & (nearest < posed[:, 2] - margin))]
    return kept if len(kept) >= _FEWEST_PAIRS else rows


def nudged(hypothesis: Hypothesis, cluster: Cluster, seed: int) -> Hypothesis:
    """Align a part anew from a pose beside its own, and return the better of the two.

    Among others like it an alignment often ends beside the best pose, half on a neighbour.
    """
    rng, part, pose = np.random.default_rng(seed), hypothesis.part, hypothesis.pose.copy()
    axis, shift = (one / np.linalg.norm(one) for one in rng.normal(size=(2, 3)))
    middle = pose[:3, :3] @ part.middle + pose[:3, 3]
    pose[:3, :3] = axis_turn(axis, _NUDGED[0]) @ pose[:3, :3]
    pose[:3, 3] = middle - pose[:3, :3] @ part.middle + _NUDGED[1] * part.diameter * shift
    other = settled(verify(cluster.picture, part, pose), cluster)
    return other if other.value > hypothesis.value else hypothesis
