"""Networks without adaptation: does training on scans beat training on surfaces?

Paper: QS³ (ECCV 2022), main table of ordinary classification, Sim2Real: M→D, S→D, M→S*, S→S*.
Command: ``qs3 reproduce ordinary --out DIR`` (``--dry-run`` prints the hours on this machine).
Published: S over M on D +12.5, +17.3, +4.2, +7.7 points for the four networks.
"""

from qs3.experiments.cells import networks, published_cells, published_source, tasks
from qs3.experiments.experiment import Experiment, Place
from qs3.experiments.rows import ORDINARY
from qs3.experiments.runs import Run, make_run
from qs3.experiments.scales import Scale


def _run(scale: Scale, row: str, column: str, seed: int, threads: int | None) -> Run:
    return make_run(scale, column, ORDINARY, seed, threads, network=row)


def _pairs(scale: Scale) -> list[tuple[str, Place, Place]]:
    return [
        (f"S over M on {target}, {title}", (row, f"S-{target}"), (row, f"M-{target}"))
        for target in ("D", "F")
        for row, title in networks(scale)
    ]


EXPERIMENT = Experiment(
    name="ordinary",
    title="Networks without adaptation, simulation to target",
    source=published_source("ordinary"),
    rows=networks,
    columns=lambda scale: tasks("M-D", "S-D", "M-F", "S-F"),
    run=_run,
    published=published_cells("ordinary"),
    pairs=_pairs,
)
"""The paper's main table."""
