"""Which clouds a run has seen: by their bytes, and by their shape where they were written anew."""

from collections.abc import Collection, Iterable, Sequence
from itertools import combinations_with_replacement
from typing import Any

import numpy as np
from jaxtyping import Float

from qs3.errors import InputError
from qs3.io.clouds import digests
from qs3.io.preparation import unit_ball
from qs3.training.prepared import Prepared
from qs3.training.run import Run, data_record

TOLERANCE = 1e-3
"""Largest difference of a moment between a cloud and the same one written anew. The nearest two
different clouds of ModelNet10 are 2.7e-3 apart, of NYUv2's objects 2.4e-2; noise of 1e-4 on every
point makes 4e-4 at most, float16 and a shift less, another order of the points nothing."""
_UNIT = 1e-4
"""Unit of the whole numbers in a shape's text."""
_MOMENTS = [axes for k in (2, 3) for axes in combinations_with_replacement(range(3), k)]


def shapes(points: Iterable[Float[np.ndarray, "n 3"]]) -> list[str]:
    """Describe clouds by what stays when they are written anew: moments of second and third order.

    They are taken about the mean, in units of the root mean square distance from there: order,
    place and scale of the points do not matter. A cloud without extent, which would look like any
    other of its kind, is left out.

    Returns:
        Sixteen numbers of 16 bits a cloud, as hexadecimal text.
    """
    texts = []
    for cloud in points:
        centred = cloud - cloud.mean(axis=0, dtype=np.float64)
        radius = np.sqrt(np.square(centred).sum(axis=1).mean())
        if radius > 1e-6 * np.abs(cloud).max(initial=0.0):
            x = (centred / radius).T
            moments = np.array([x[list(axes)].prod(axis=0).mean() for axes in _MOMENTS])
            numbers = (moments / _UNIT).round().clip(-32768, 32767)
            texts.append(numbers.astype("<i2").tobytes().hex())
    return texts


def seen_clouds(prepared: Prepared) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Return checksums and shapes of clouds that a network gets to see, for its ``run.json``.

    Their shapes are those of what it gets and, where that is less, of the clouds as read.
    """
    return tuple(checksums(prepared)), tuple(dict.fromkeys(_both_shapes(prepared)))


def data_fields(source: Prepared, target: Prepared | None, has_seen_target: bool) -> dict[str, Any]:
    """Return the fields of a `Run` that tell of its data, prepared but whole."""
    source_clouds, source_shapes = seen_clouds(source)
    seen = ((), ()) if target is None or not has_seen_target else seen_clouds(target)
    return {
        "source": data_record(source.clouds),
        "target": None if target is None else data_record(target.clouds),
        "source_clouds": source_clouds,
        "source_shapes": source_shapes,
        "target_clouds": seen[0],
        "target_shapes": seen[1],
    }


def checksums(prepared: Prepared) -> list[str]:
    """Return checksums of the chosen points of each cloud, as read."""
    return [text for block in prepared.blocks() for text in digests(block)]


def both_checksums(prepared: Prepared) -> tuple[list[str], list[str]]:
    """Return checksums of the chosen points of each cloud, as read and in the unit ball."""
    balls = [text for block in prepared.blocks() for text in digests(unit_ball(block))]
    return checksums(prepared), balls


def _both_shapes(prepared: Prepared) -> list[str]:
    texts = [text for block in prepared.blocks() for text in shapes(block)]
    if prepared.order is not None:
        texts += shapes(prepared.clouds.points[row] for row in prepared.rows)
    return texts


def caveats(run: Run, prepared: Prepared) -> tuple[str, ...]:
    """Caveats of a score: which of the tested clouds the run has seen.

    Args:
        run: The run.
        prepared: The tested clouds.
    """
    tested = {text for texts in both_checksums(prepared) for text in texts}
    texts = _both_shapes(prepared)

    def has_seen(clouds: Collection[str], known: Sequence[str]) -> bool:
        return not tested.isdisjoint(clouds) or _near(known, texts, run)

    marks = {
        "transductive": has_seen(run.target_clouds, run.target_shapes),
        "supervised": run.supervised,
        "training clouds": has_seen(run.source_clouds, run.source_shapes),
        "warm-up of unknown origin": run.unknown_warm_up,
    }
    return tuple(mark for mark, holds in marks.items() if holds)


def _near(known: Sequence[str], tested: Sequence[str], run: Run) -> bool:
    """Whether one of the tested shapes is one of those known, but for rounding."""
    from scipy.spatial import KDTree

    if not known or not tested:
        return False
    try:
        seen, asked = (
            np.frombuffer(bytes.fromhex("".join(texts)), "<i2").reshape(len(texts), len(_MOMENTS))
            for texts in (known, tested)
        )
    except ValueError as error:
        raise InputError(f"{run.folder}: shapes of clouds in run.json are damaged") from error
    distances, _ = KDTree(seen).query(asked, p=np.inf)
    return bool(distances.min() * _UNIT <= TOLERANCE)
