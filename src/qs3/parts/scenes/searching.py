"""Which parts explain a cut picture: those of the last frame that stay, and those searched for."""

from collections.abc import Iterable
from dataclasses import replace

import numpy as np
from jaxtyping import Bool

from qs3.parts.library import Library
from qs3.parts.scenes.choosing import choose
from qs3.parts.scenes.confidence import rival_of
from qs3.parts.scenes.found import FindSettings, FoundParts, Unexplained
from qs3.parts.scenes.limits import is_good, is_sure
from qs3.parts.scenes.picture import Picture, pieces_of
from qs3.parts.scenes.proposing import Cluster, lain_all, nudged, propose_all, settled
from qs3.parts.scenes.verifying import Hypothesis, verify

_PIECE = 100
"""Pixels of a rest that is searched again, at least."""
_ROUNDS, _NUDGES = 4, 3
"""Most searches in a cluster, and alignments anew of what each chooses."""


def chosen_in(
    library: Library,
    picture: Picture,
    settings: FindSettings,
    before: FoundParts | None = None,
) -> list[Hypothesis]:
    """Return the parts that together explain a picture best, however sure each is."""
    chosen = [] if before is None else _held(library, picture, before)
    claimed, least = claimed_by(picture.cluster >= 0, chosen), max(_PIECE, settings.min_points)
    for number in range(picture.clusters):
        mask = picture.cluster == number
        if before is not None:
            pieces = pieces_of(mask, claimed, least, picture.blur)
            pieces = [piece for piece in pieces if not _seen_before(picture, piece, before)]
            mask = np.any(pieces, axis=0) if pieces else np.zeros_like(mask)
        if mask.any():
            chosen += _explained(library, picture, mask, settings)
    return choose([h for h in chosen if is_good(picture, h)])


def _held(library: Library, picture: Picture, before: FoundParts) -> list[Hypothesis]:
    """Return the parts of the last frame that are still there, from their last poses."""
    known = {part.cad: part for part in library}
    parts = [part for part in before.parts if part.cad in known]
    if not parts:
        return []
    cluster = Cluster.of(picture, picture.cluster >= 0)
    held = [
        replace(settled(verify(picture, known[part.cad], part.pose), cluster), rival=part.rival)
        for part in parts
    ]
    return choose([h for h in held if is_good(picture, h)])


def _seen_before(picture: Picture, piece: Bool[np.ndarray, "h w"], before: FoundParts) -> bool:
    """Return whether the last frame had the same rest, which no part explained by far."""
    now = Unexplained.of(picture.points(piece))
    return any(not rest.doubted and rest.is_still(now) for rest in before.unexplained)


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
        found = [h for h in found if is_good(picture, h)]
        chosen = choose(found)
        for seed in range(_NUDGES):
            better = [nudged(h, cluster, seed) for h in chosen]
            found += [h for h in better if h not in chosen and is_good(picture, h)]
            chosen = choose(found)
        sure = [h for h in chosen if is_sure(picture, h)]
        pieces = pieces_of(mask, claimed_by(mask, chosen), least, picture.blur)
        if not pieces and (step or len(sure) == len(chosen)):
            break
        # A part that is not sure may have taken what belongs to its neighbour. What was searched
        # already would show the same again: then what no part explains is searched by itself.
        lefts = [mask & ~claimed_by(mask, kept) for kept in (sure, chosen)]
        fresh = [m for m in lefts if not any(np.array_equal(m, done) for done in searched)]
        if not fresh:
            break
        left = fresh[0]
    return [replace(h, rival=rival_of(h, found)) for h in chosen]


def claimed_by(
    mask: Bool[np.ndarray, "h w"], chosen: Iterable[Hypothesis]
) -> Bool[np.ndarray, "h w"]:
    """Return the pixels of parts in a picture of the shape of a mask."""
    claimed = np.zeros_like(mask)
    for h in chosen:
        claimed.flat[h.pixels] = True
    return claimed
