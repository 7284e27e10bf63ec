"""Networks trained on the target and scored on simulations: which simulation is closer?

Paper: QS³ (ECCV 2022), supplement, Table 1 (Real2Sim): D→M and D→S for four networks.
Command: ``qs3 reproduce real2sim --out DIR`` (``--dry-run`` prints the hours on this machine).
Published: D→S over D→M +14.9, +11.4, +13.0, +5.0 points.
"""

from qs3.experiments.cells import networks, published_cells, published_source, tasks
from qs3.experiments.experiment import Experiment, Place
from qs3.experiments.rows import ORDINARY
from qs3.experiments.runs import Run, make_run
from qs3.experiments.scales import Scale


def _run(scale: Scale, row: str, column: str, seed: int, threads: int | None) -> Run:
    return make_run(scale, column, ORDINARY, seed, threads, network=row)


def _pairs(scale: Scale) -> list[tuple[str, Place, Place]]:
    return [(f"S over M, {title}", (row, "D-S"), (row, "D-M")) for row, title in networks(scale)]


EXPERIMENT = Experiment(
    name="real2sim",
    title="Networks trained on the target, scored on simulations",
    source=published_source("real2sim"),
    rows=networks,
    columns=lambda scale: tasks("D-M", "D-S"),
    run=_run,
    published=published_cells("real2sim"),
    pairs=_pairs,
)
"""The supplement's Table 1."""
