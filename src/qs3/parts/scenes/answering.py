"""From the parts that explain a picture to its answer: their scores, their poses, and the rest."""

from collections import Counter
from collections.abc import Iterable, Sequence

import numpy as np

from qs3.parts.scenes.confidence import confidence
from qs3.parts.scenes.found import FindSettings, FoundPart, FoundParts, Unexplained
from qs3.parts.scenes.picture import Picture, pieces_of
from qs3.parts.scenes.searching import claimed_by
from qs3.parts.scenes.verifying import Hypothesis

_HELD = 0.5
"""Share of the least score that a part of the last frame needs, and a rest to be searched again."""
_SURE = 0.5
"""Probability from which a part makes it likely that more of its kind lie about."""
_UNLIKELY = 0.1
"""Probability below which a part explains nothing of what its neighbours are joined to: many small
parts that tile a foreign thing would vouch for each other."""


def answer_of(
    chosen: Sequence[Hypothesis],
    picture: Picture,
    settings: FindSettings,
    last: Sequence[FoundPart],
) -> FoundParts:
    """Return the answer for a picture that some parts explain; ``last`` are the last frame's."""
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
        earlier = _last(h, last)
        if h.part.beyond:  # its size is not that of its CAD, so its pose is none
            continue
        # A part of the last frame does not come and go with the noise.
        if score >= settings.least_score * (1 if earlier is None else _HELD):
            sure.append(h)
            parts.append(_part(h, score, earlier))
        elif score >= settings.least_score * _HELD:
            doubted.append(h)
    parts.sort(key=lambda part: -part.score)
    rest = _rest(picture, sure, doubted, settings)
    return FoundParts(tuple(parts), rest, picture.camera_from_table)


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
    part = hypothesis.part
    # Not `last` times the turn since: that multiplies its rounding in each frame.
    pose = part.symmetry.canonical(hypothesis.pose, None if last is None else last.pose)
    left, _, right = np.linalg.svd(pose[:3, :3])
    pose[:3, :3] = left @ right  # nor is what a caller's pose is off passed on
    whole = max(hypothesis.area + hypothesis.beyond, 1e-9)
    return FoundPart(
        part.class_name, part.cad, pose, score, hypothesis.residual, hypothesis.continued,
        hypothesis.rival, float(hypothesis.agreed / whole), len(hypothesis.pixels),
        part.symmetry, part.times,
    )  # fmt: skip


def _rest(
    picture: Picture,
    chosen: Iterable[Hypothesis],
    doubted: Iterable[Hypothesis],
    settings: FindSettings,
) -> tuple[Unexplained, ...]:
    """Return what is left of the clusters."""
    claimed = claimed_by(picture.cluster >= 0, chosen)
    found = []
    for number in range(picture.clusters):
        mask = picture.cluster == number
        for piece in pieces_of(mask, claimed, settings.min_points, picture.blur):
            is_doubted = any(piece.flat[h.pixels].any() for h in doubted)
            found.append(Unexplained.of(picture.points(piece), is_doubted))
    return tuple(sorted(found, key=lambda rest: -rest.points))
