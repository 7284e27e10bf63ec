"""Methods of adaptation, as the paper compares them.

Paper: QS³ (ECCV 2022), main table of adaptation and supplement, Table 2: M→D, S→D, S→S*, DGCNN.
Published: QBST 66.4 on M→D; QS³ 72.4 on S→D and 57.4 on S→S*, 8.4 and 6.3 over no adaptation.

QBST has the settings of the paper's text here (preset ``paper``); the bench of adaptation
(`qs3.experiments.tables.adaptation_bench`) has ours, more methods and every rule of selection.
"""

from qs3.experiments.experiment import Experiment, lines, tasks
from qs3.experiments.runs import ORDINARY, PAPER, SUPERVISED

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
_TASKS = tasks(("M", "D"), ("S", "D"), ("S", "F"))
_PAIRS = (
    *((f"{_TITLES[row]} over no adaptation", row, ORDINARY) for row in list(_TITLES)[2:]),
    *((f"QBST over {_TITLES[row]}", PAPER, row) for row in ("gast-spst", "defrec-pcm")),
)

EXPERIMENT = Experiment(
    title="Unsupervised adaptation",
    rows=lambda scale: lines(_TITLES),
    columns=lambda scale: _TASKS,
    published="methods",
    published_as={ORDINARY: "source-only", PAPER: "qbst"},
    pairs=lambda scale: _PAIRS,
    corner="method",
)
"""The paper's second table, with the supplement's column."""
