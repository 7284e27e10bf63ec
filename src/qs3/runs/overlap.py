"""Which of the clouds that a run is scored on it has seen in its training."""

from qs3.runs.digests import PreparedClouds, alike, all_checksums, shapes
from qs3.runs.run import Run


def caveats(run: Run, prepared: PreparedClouds) -> tuple[str, ...]:
    """Return the caveats of a score: which of the tested clouds the run has seen.

    A cloud is known again by its points, or by its shape though it was moved, scaled, reordered or
    rounded (`qs3.runs.digests`).
    """
    tested = {text for texts in all_checksums(prepared) for text in texts}
    whole = shapes(prepared.clouds.points[prepared.rows])
    marks = {
        "transductive": not tested.isdisjoint(run.target_clouds)
        or alike(whole, run.target_shapes).any(),
        "supervised": run.supervised,
        "training clouds": not tested.isdisjoint(run.source_clouds)
        or alike(whole, run.source_shapes).any(),
        "warm-up of unknown origin": run.unknown_warm_up,
    }
    return tuple(mark for mark, holds in marks.items() if holds)
