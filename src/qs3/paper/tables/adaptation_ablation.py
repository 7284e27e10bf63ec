"""The switches of QBST, S → D; all else as in the bench of adaptation.

Not in the paper, whose text and released code differ in these switches (`qs3.runs.settings`).
"""

from qs3.paper.cells import PAPER
from qs3.paper.experiment import Experiment, lines, tasks
from qs3.paper.scales import Scale

_SWITCHES = {
    "qbst": ("least-confident", "scratch", "best-labeller", "no-source-loss"),
    PAPER: ("source-loss", "warm-up", "whole-pool", "long"),
}


def experiment(scale: Scale) -> Experiment:
    """Return rows of both settings, and of each with one change."""
    pairs = [(row, f"{row}-{name}") for row, names in _SWITCHES.items() for name in names]
    return Experiment(
        title="Ablation of QBST",
        rows=lines({row: row for pair in pairs for row in pair}),
        columns=tasks(("S", "D")),
        published="methods",
        pairs=[(f"{changed} over {row}", changed, row) for row, changed in pairs],
        corner="method",
        fixed=("M", "S", "D", "R"),
    )
