"""Clouds that a run has seen, by checksums of their points."""

from typing import Any

from qs3.io.clouds import digests
from qs3.io.preparation import unit_ball
from qs3.training.prepared import Prepared
from qs3.training.run import Run, data_record


def data_fields(source: Prepared, target: Prepared | None, has_seen_target: bool) -> dict[str, Any]:
    """Return the fields of a `Run` that describe its data, prepared but whole."""
    return {
        "source": data_record(source.clouds),
        "target": None if target is None else data_record(target.clouds),
        "source_clouds": tuple(checksums(source)),
        "target_clouds": tuple(checksums(target)) if target is not None and has_seen_target else (),
    }


def checksums(prepared: Prepared) -> list[str]:
    """Return checksums of the chosen points of each cloud, as read."""
    return [text for block in prepared.blocks() for text in digests(block)]


def both_checksums(prepared: Prepared) -> tuple[list[str], list[str]]:
    """Return checksums of the chosen points of each cloud, as read and in the unit ball."""
    balls = [text for block in prepared.blocks() for text in digests(unit_ball(block))]
    return checksums(prepared), balls


def caveats(run: Run, prepared: Prepared) -> tuple[str, ...]:
    """Caveats of a score: which of the tested clouds the run has seen.

    A cloud that was written again with other bytes (rounded, moved, in another order) is not
    recognised.

    Args:
        run: The run.
        prepared: The tested clouds.
    """
    tested = {text for texts in both_checksums(prepared) for text in texts}
    marks = {
        "transductive": not tested.isdisjoint(run.target_clouds),
        "supervised": run.supervised,
        "training clouds": not tested.isdisjoint(run.source_clouds),
        "warm-up of unknown origin": run.unknown_warm_up,
    }
    return tuple(mark for mark, holds in marks.items() if holds)
