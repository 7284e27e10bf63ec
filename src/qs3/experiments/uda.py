"""Methods of adaptation, as the paper compares them.

Paper: QS³ (ECCV 2022), main table of adaptation and supplement, Table 2: M→D, S→D, S→S*, DGCNN.
Command: ``qs3 reproduce uda --out DIR`` (``--dry-run`` prints the hours on this machine).
Published: QBST 66.4 on M→D; QS³ 72.4 on S→D and 57.4 on S→S*, 8.4 and 6.3 over no adaptation.

QBST has the settings of the paper's text here (preset ``paper``); the bench of adaptation
(`qs3.experiments.adaptation_bench`) has ours, more methods and every rule of selection.
"""

from qs3.experiments.cells import published_cells, published_source, tasks
from qs3.experiments.experiment import Experiment, Named, Place
from qs3.experiments.rows import ORDINARY, PAPER, SUPERVISED, TABLE_ROWS
from qs3.experiments.runs import Run, make_run
from qs3.experiments.scales import Scale

_OURS = {"source-only": ORDINARY, "qbst": PAPER}
_TITLES = {
    SUPERVISED: "Supervised",
    ORDINARY: "without adaptation",
    "pointdan": "PointDAN",
    "defrec": "DefRec",
    "defrec-pcm": "DefRec + PCM",
    "gast": "GAST without SPST",
    "gast-spst": "GAST",
    PAPER: "QBST (on S: QS³)",
}


def _rows(scale: Scale) -> Named:
    keys = [_OURS.get(row, row) for row in TABLE_ROWS]
    return tuple((key, _TITLES[key]) for key in keys)


def _run(scale: Scale, row: str, column: str, seed: int, threads: int | None) -> Run:
    # Trained on the target's own labels: one for both sources.
    task = f"S-{column[-1]}" if row == SUPERVISED else column
    return make_run(scale, task, row, seed, threads)


def _pairs(scale: Scale) -> list[tuple[str, Place, Place]]:
    found = [
        (f"{_TITLES[key]} over no adaptation, {heading}", (key, task), (ORDINARY, task))
        for task, heading in tasks("M-D", "S-D", "S-F")
        for key in ("pointdan", "defrec", "defrec-pcm", "gast", "gast-spst", PAPER)
    ]
    found += [
        (f"QBST over {_TITLES[key]}, {heading}", (PAPER, task), (key, task))
        for task, heading in tasks("M-D", "S-D", "S-F")
        for key in ("gast-spst", "defrec-pcm")
    ]
    return found


EXPERIMENT = Experiment(
    name="uda",
    title="Unsupervised adaptation",
    source=published_source(""),
    rows=_rows,
    columns=lambda scale: tasks("M-D", "S-D", "S-F"),
    run=_run,
    published=published_cells("", _OURS),
    pairs=_pairs,
    corner="method",
)
"""The paper's second table, with the supplement's column."""
