"""The switches of QBST, S → D; all else as in the bench of adaptation.

Not in the paper, whose text and released code differ in these switches (`qs3.training.config`).
"""

from qs3.experiments.experiment import Experiment, lines, tasks

_ROWS = (
    "qbst",
    "qbst-least-confident",
    "qbst-scratch",
    "qbst-best-labeller",
    "qbst-no-source-loss",
)

EXPERIMENT = Experiment(
    title="Ablation of QBST",
    rows=lambda scale: lines({row: row for row in _ROWS}),
    columns=lambda scale: tasks(("S", "D")),
    published="methods",
    pairs=lambda scale: [(f"{row} over qbst", row, "qbst") for row in _ROWS[1:]],
    corner="method",
    made=("M", "S", "D", "R"),
)
