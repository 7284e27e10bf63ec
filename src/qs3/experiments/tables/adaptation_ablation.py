"""The switches of QBST, S → D; all else as in the bench of adaptation.

Not in the paper, whose text and released code differ in these switches (`qs3.training.config`).
"""

from qs3.experiments.experiment import Experiment, lines, tasks
from qs3.experiments.runs import PAPER

_ROWS = (
    "qbst",
    "qbst-least-confident",
    "qbst-scratch",
    "qbst-best-labeller",
    "qbst-no-source-loss",
)
_PAPER = (PAPER, *(f"{PAPER}-{name}" for name in ("source-loss", "warm-up", "whole-pool", "long")))

EXPERIMENT = Experiment(
    title="Ablation of QBST",
    rows=lambda scale: lines({row: row for row in _ROWS + _PAPER}),
    columns=lambda scale: tasks(("S", "D")),
    published="methods",
    pairs=lambda scale: [
        (f"{row} over {first}", row, first) for first, *others in (_ROWS, _PAPER) for row in others
    ],
    corner="method",
    made=("M", "S", "D", "R"),
)
