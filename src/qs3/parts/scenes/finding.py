"""What `qs3 find` asks: the parts in one depth picture, and the clusters that no part explains."""

from collections import Counter
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float, Float32, Int32
from numpy.typing import ArrayLike

from qs3.checks import Share, array_of, check, check_kind
from qs3.errors import InputError, say_once
from qs3.frames.camera_files import read_intrinsics
from qs3.frames.intrinsics import Intrinsics
from qs3.geometry import invert_rigid
from qs3.objects.segment import NoPlaneError, SegmentSettings, no_plane
from qs3.parts.library import Library
from qs3.parts.scenes.choosing import choose
from qs3.parts.scenes.confidence import confidence, rival_of
from qs3.parts.scenes.picture import Picture, picture_of, pieces_of
from qs3.parts.scenes.proposing import Cluster, lain_all, nudged, propose_all, settled
from qs3.parts.scenes.verifying import SHARP, Hypothesis, bent, verify
from qs3.parts.symmetry import Symmetry

_LEAST = 40
"""Pixels of a part at least."""
GAP = 0.01
"""Metres between clusters; parts that are nearer are told apart by their CAD."""
_PIECE = 100
"""Pixels of a rest that is searched again, at least."""
_CONTINUED = 0.45
"""Share of the outline of a part that may lie within a larger surface."""
_BENT = 0.27
"""Tolerances of `bent` up to which a part is good: on simulated tables right poses have
0.02 to 0.26, and parts of another shape 0.26 to 0.4."""
_AGREED = 0.5
"""Least agreement of a part with the picture."""
_BEYOND = 0.5
"""Most of the visible surface that lies beyond the picture, by what lies within: what fills the
picture shows no outline, and agrees with parts of many kinds."""
_CLUSTERED = 0.5
"""Least share of the pixels of a part that stand on the table: none beyond its rim do."""
_HELD = 0.5
"""Share of the least score that a part of the last frame needs, and a rest to be searched again."""
_STILL, _ALIKE = 0.01, 0.25
"""Metres by which a rest may move, and share of its points that may come or go, to be the same."""
_SUNK = 0.1
"""Diameters by which a part may reach under the table, at most, if the camera smooths depth: to one
that does not a part that lies in a hole is as sure as another."""
_SIDE = 0.5
"""Share of a part that is visible, at least, if its side was taken for the table."""
_ROUNDS, _NUDGES = 4, 3
"""Most searches in a cluster, and alignments anew of what each chooses."""
_SURE = 0.5
"""Probability from which a part makes it likely that more of its kind lie about."""
_UNLIKELY = 0.1
"""Probability below which a part explains nothing of what its neighbours are joined to: many small
parts that tile a foreign thing would vouch for each other."""


@dataclass(frozen=True)
class FindSettings:
    """Settings of the search in a picture."""

    far: float = float("inf")
    """Depths at or beyond are dropped, metres."""
    gravity: tuple[float, float, float] | None = None
    """Approximate downward direction in the camera's axes; None finds it from the table."""
    height: float = 0.5
    """Largest height of parts above the table, metres."""
    min_points: int = _LEAST
    """Clusters of fewer points are left out."""
    least_score: Share = 0.5
    """Parts of a lower score are left unexplained. A part of the last frame stays down to half of
    it, so that it does not come and go with the noise."""

    def __post_init__(self) -> None:
        check(self, "find")
        _ = self.cutting

    @property
    def cutting(self) -> SegmentSettings:
        """How the picture is cut."""
        return SegmentSettings(
            far=self.far, gravity=self.gravity, height=self.height, gap=GAP,
            min_points=self.min_points,
        )  # fmt: skip


@dataclass(frozen=True)
class FoundPart:
    """One part of a picture."""

    class_name: str
    cad: str
    """Id of the CAD file in its folder."""
    pose: Float[np.ndarray, "4 4"]
    """Camera from part, metres: the vertices of the file as it stands on disk, times `scale`, to
    OpenCV's axes. Of all poses that look the same it is the one that is turned least; of a part of
    the last frame the one nearest to its pose there."""
    score: float
    """Probability that class and pose are right, as measured on simulated scenes of other parts;
    the confidence of `qs3.answers` is that of the class alone."""
    residual: float
    """Metres: root mean square distance of the part's pixels from its surface, along the normal."""
    continued: float
    """Share of the outline beyond which the measured surface simply goes on: high for a part that
    was seen into something larger."""
    rival: float
    """How well another part or pose explains the same pixels, by how well this one does; 0 if none
    does."""
    visible: float
    """Share of the surface towards the camera that the picture shows; the rest is hidden."""
    points: int
    """Pixels that lie on the part."""
    symmetry: Symmetry
    """Of the CAD: ``pose @ equals`` are the poses that look the same."""
    scale: float = 1.0
    """How many times larger the part is than its file, as ``qs3 adapt --tolerance`` found it."""


@dataclass(frozen=True)
class Unexplained:
    """A cluster, or a rest of one, that no part of the library explains."""

    points: int
    centre: tuple[float, float, float]
    """Middle of its points in the camera's axes, metres."""
    size: float
    """Metres from its middle to the farthest point, twice."""
    doubted: bool = False
    """Whether a part was found there with a score from half of the least one up; the next frame is
    searched there again, even if nothing changed."""


@dataclass(frozen=True)
class FoundParts:
    """Answer for one picture."""

    parts: tuple[FoundPart, ...]
    """Highest score first."""
    unexplained: tuple[Unexplained, ...]
    """Largest first."""
    camera_from_table: Float[np.ndarray, "4 4"] | None
    """The table is z = 0 and z is up; None for a bin so full that no table is seen."""


def find(
    library: Library,
    depth: ArrayLike,
    intrinsics: Intrinsics | str | Path,
    settings: FindSettings = FindSettings(),
    masks: ArrayLike | None = None,
    before: FoundParts | None = None,
) -> FoundParts:
    """Find the parts on a table in a depth picture: class, CAD file and pose of each.

    Args:
        library: The parts that may be there.
        depth: Metres along the optical axis, floating point, [h, w]; NaN or 0 if unknown.
        intrinsics: The camera of the picture, or what ``--intrinsics`` takes: fx,fy,cx,cy or a
            file.
        settings: See `FindSettings`.
        masks: Whole numbers of objects from a detector, 0 for none; they replace the segmentation.
        before: Answer for the last frame of a camera. Its parts are refined from their poses, and
            only what they no longer explain is searched, unless it has not changed.

    Raises:
        NoPlaneError: If the picture shows neither a table nor, searched without one, a part.
        InputError: If the picture is not in metres, has no depth, or another size than the camera
            or the masks.
    """
    check_kind("find", library, Library)
    check_kind("find", settings, FindSettings)
    if before is not None:
        check_kind("find", before, FoundParts)
    if not isinstance(intrinsics, Intrinsics):
        intrinsics = read_intrinsics(intrinsics)
    depth, masks = array_of("depth", depth), None if masks is None else array_of("masks", masks)
    if depth.ndim != 2 or depth.dtype.kind != "f":
        raise InputError(
            f"depth is {depth.dtype} of shape {list(depth.shape)}; give metres of shape [h, w] as "
            "floating-point numbers: millimetres times 0.001"
        )
    if masks is not None and (masks.ndim != 2 or masks.dtype.kind not in "biu"):
        raise InputError(
            f"masks are {masks.dtype} of shape {list(masks.shape)}; give whole numbers of shape "
            "[h, w], 0 for no object"
        )
    if masks is not None and masks.shape != depth.shape:
        raise InputError(
            f"the masks are {masks.shape[1]}×{masks.shape[0]} pixels, the depth picture "
            f"{depth.shape[1]}×{depth.shape[0]}"
        )
    numbers = None if masks is None else masks.astype(np.int32)
    depth = depth.astype(np.float32)
    return find_cut(library, depth, intrinsics, settings.cutting, settings, numbers, before)


def find_cut(
    library: Library,
    depth: Float32[np.ndarray, "rows columns"],
    intrinsics: Intrinsics,
    cutting: SegmentSettings,
    settings: FindSettings = FindSettings(),
    masks: Int32[np.ndarray, "rows columns"] | None = None,
    before: FoundParts | None = None,
) -> FoundParts:
    """Find the parts as `find` does, in a picture that is cut by settings of one's own.

    A picture without a table is searched without one, and a warning gives the reason once. So is
    one in which nothing is found on a plane that is no larger than a part and ends within the
    picture: a side of it.
    """
    found = None
    try:
        picture = picture_of(depth, intrinsics, cutting, masks)
        found = find_in(library, picture, settings, before)
        if found.parts or _is_table(library, picture):
            return found
        fault = no_plane("its plane is no larger than a part", cutting)
    except NoPlaneError as error:
        fault = error
    picture = picture_of(depth, intrinsics, cutting, masks, table=False)
    bare = find_in(library, picture, settings, before)
    # A part that is much larger than the picture would take the table for its side.
    if bare.parts and (found is None or bare.parts[0].visible >= _SIDE):
        more = f"no table: {fault.fault}, so it is searched without one"
        say_once(str(no_plane(more, cutting)), "no table")
        return bare
    if found is None:
        raise no_plane(f"{fault.fault}, and no part is found without a table", cutting) from fault
    return found


def _is_table(library: Library, picture: Picture) -> bool:
    """Return whether the table is larger than each part, or goes on beyond the picture."""
    table = picture.cluster == -1
    size = np.ptp(picture.points(table), axis=0).max()
    rim = np.concatenate([table[0], table[-1], table[:, 0], table[:, -1]])
    return bool(size > max((part.diameter for part in library), default=0.0) or rim.mean() > 0.5)


def find_in(
    library: Library,
    picture: Picture,
    settings: FindSettings = FindSettings(),
    before: FoundParts | None = None,
) -> FoundParts:
    """Find the parts in a picture that is cut already, as `find` does."""
    last = () if before is None else before.parts
    chosen = chosen_in(library, picture, settings, before)
    sure, doubted, parts = [], [], []
    scores = [confidence(h, chosen, picture) for h in chosen]
    likely = [h for h, score in zip(chosen, scores, strict=True) if score >= _UNLIKELY]
    if len(likely) < len(chosen):
        scores = [confidence(h, likely, picture) for h in chosen]
    sure_of = Counter(h.part.cad for h, score in zip(chosen, scores, strict=True) if score >= _SURE)
    scores = [
        confidence(h, likely, picture, sure_of[h.part.cad] - (score >= _SURE))
        for h, score in zip(chosen, scores, strict=True)
    ]
    for h, score in zip(chosen, scores, strict=True):
        own = _last(h, last)
        if h.part.beyond:  # its size is not that of its CAD, so its pose is none
            continue
        # A part of the last frame does not come and go with the noise.
        if score >= settings.least_score * (1 if own is None else _HELD):
            sure.append(h)
            parts.append(_part(h, score, own))
        elif score >= settings.least_score * _HELD:
            doubted.append(h)
    parts.sort(key=lambda part: -part.score)
    rest = _rest(picture, sure, doubted, settings)
    return FoundParts(tuple(parts), rest, picture.camera_from_table)


def chosen_in(
    library: Library,
    picture: Picture,
    settings: FindSettings = FindSettings(),
    before: FoundParts | None = None,
) -> list[Hypothesis]:
    """Return the parts that together explain a picture best, however sure each is."""
    chosen = [] if before is None else _held(library, picture, before)
    claimed, least = _claimed(picture.cluster >= 0, chosen), max(_PIECE, settings.min_points)
    for number in range(picture.clusters):
        mask = picture.cluster == number
        if before is not None:
            pieces = pieces_of(mask, claimed, least, picture.blur)
            pieces = [piece for piece in pieces if not _seen_before(picture, piece, before)]
            mask = np.any(pieces, axis=0) if pieces else np.zeros_like(mask)
        if mask.any():
            chosen += _explained(library, picture, mask, settings)
    return choose([h for h in chosen if _good(picture, h)])


def _held(library: Library, picture: Picture, before: FoundParts) -> list[Hypothesis]:
    """Return the parts of the last frame that are still there, from their last poses."""
    known = {part.cad: part for part in library}
    parts = [part for part in before.parts if part.cad in known]
    if not parts:
        return []
    cluster = Cluster.of(picture, picture.cluster >= 0)
    held = [
        replace(settled(verify(picture, known[own.cad], own.pose), cluster), rival=own.rival)
        for own in parts
    ]
    return choose([h for h in held if _good(picture, h)])


def _seen_before(picture: Picture, piece: Bool[np.ndarray, "h w"], before: FoundParts) -> bool:
    """Return whether the last frame had the same rest, which no part explained by far."""
    points = picture.points(piece)
    middle = np.median(points, axis=0)
    return any(
        not rest.doubted
        and np.linalg.norm(middle - np.array(rest.centre)) < _STILL
        and abs(rest.points - len(points)) < _ALIKE * rest.points
        for rest in before.unexplained
    )


def _explained(
    library: Library, picture: Picture, mask: Bool[np.ndarray, "h w"], settings: FindSettings
) -> list[Hypothesis]:
    """Return the parts of one cluster, first sought among those that lie on the table, if any."""
    least = max(_PIECE, settings.min_points)
    found: list[Hypothesis] = []
    chosen: list[Hypothesis] = []
    left, searched = mask, list[Bool[np.ndarray, "h w"]]()
    first = int(picture.camera_from_table is None)
    for step in range(first, first + _ROUNDS):
        cluster = Cluster.of(picture, left)
        if step != 1 or not np.array_equal(left, mask):  # else they were found at step 0
            found += lain_all(library, cluster)
        if step:  # not all lie
            found += propose_all(library, cluster)
            searched.append(left)
        found = [h for h in found if _good(picture, h)]
        chosen = choose(found)
        for seed in range(_NUDGES):
            better = [nudged(h, cluster, seed) for h in chosen]
            found += [h for h in better if h not in chosen and _good(picture, h)]
            chosen = choose(found)
        sure = [h for h in chosen if _sure(picture, h)]
        pieces = pieces_of(mask, _claimed(mask, chosen), least, picture.blur)
        if not pieces and (step or len(sure) == len(chosen)):
            break
        # A part that is not sure may have taken what belongs to its neighbour. What was searched
        # already would show the same again: then what no part explains is searched by itself.
        lefts = [mask & ~_claimed(mask, own) for own in (sure, chosen)]
        fresh = [m for m in lefts if not any(np.array_equal(m, own) for own in searched)]
        if not fresh:
            break
        left = fresh[0]
    return [replace(h, rival=rival_of(h, found)) for h in chosen]


def _claimed(
    mask: Bool[np.ndarray, "h w"], chosen: Iterable[Hypothesis]
) -> Bool[np.ndarray, "h w"]:
    """Return the pixels of parts in a picture of the shape of a mask."""
    claimed = np.zeros_like(mask)
    for h in chosen:
        claimed.flat[h.pixels] = True
    return claimed


def _within(hypothesis: Hypothesis, mask: Bool[np.ndarray, "h w"]) -> int:
    return int(mask.flat[hypothesis.pixels].sum())


def _good(picture: Picture, hypothesis: Hypothesis) -> bool:
    return (
        hypothesis.agreement >= _AGREED
        and _straight(picture, hypothesis)
        and hypothesis.continued <= _CONTINUED
        and min(len(hypothesis.pixels), hypothesis.agreed) >= _LEAST  # pixels may lie beside it
        and (picture.blur <= SHARP or hypothesis.low >= -_SUNK * hypothesis.part.diameter)
        and hypothesis.beyond <= _BEYOND * hypothesis.area
        and float(np.mean(picture.cluster.flat[hypothesis.pixels] >= 0)) >= _CLUSTERED
    )


def _sure(picture: Picture, hypothesis: Hypothesis) -> bool:
    """Return whether a part is so good that no other is sought for its pixels."""
    seen = hypothesis.agreement >= 0.9 and hypothesis.continued <= 0.1
    return seen and _straight(picture, hypothesis)


def _straight(picture: Picture, hypothesis: Hypothesis) -> bool:
    """Return whether the measured surface follows that of the part."""
    return bent(hypothesis, picture) <= _BENT


def _last(hypothesis: Hypothesis, before: Iterable[FoundPart]) -> FoundPart | None:
    """Return the part of the last frame in the place of a hypothesis, if it is of its CAD."""
    part, found = hypothesis.part, None
    middle, nearest = np.append(part.middle, 1.0), part.diameter / 2
    for last in before:
        away = float(np.linalg.norm((last.pose - hypothesis.pose)[:3] @ middle))
        if last.cad == part.cad and away < nearest:
            found, nearest = last, away
    return found


def _part(hypothesis: Hypothesis, score: float, last: FoundPart | None) -> FoundPart:
    """Return an answer; of all equal poses it is the one turned least from that of the last frame.

    Without one in its place it is the one that is turned least from the camera's axes.
    """
    part, pose = hypothesis.part, hypothesis.pose
    start = np.eye(4) if last is None else last.pose
    whole = max(hypothesis.area + hypothesis.beyond, 1e-9)
    return FoundPart(
        part.class_name, part.cad, start @ part.symmetry.canonical(invert_rigid(start) @ pose),
        score, hypothesis.residual, hypothesis.continued, hypothesis.rival,
        float(hypothesis.agreed / whole), len(hypothesis.pixels), part.symmetry, part.times,
    )  # fmt: skip


def _rest(
    picture: Picture,
    chosen: Iterable[Hypothesis],
    doubted: Iterable[Hypothesis],
    settings: FindSettings,
) -> tuple[Unexplained, ...]:
    """Return what is left of the clusters."""
    claimed = _claimed(picture.cluster >= 0, chosen)
    found = []
    for number in range(picture.clusters):
        mask = picture.cluster == number
        for piece in pieces_of(mask, claimed, settings.min_points, picture.blur):
            points = picture.points(piece)
            middle = np.median(points, axis=0)
            x, y, z = middle.tolist()
            away = np.linalg.norm(points - middle, axis=1)
            is_doubted = any(_within(h, piece) for h in doubted)
            found.append(Unexplained(len(points), (x, y, z), 2 * float(away.max()), is_doubted))
    return tuple(sorted(found, key=lambda rest: -rest.points))
