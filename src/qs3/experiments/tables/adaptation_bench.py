"""The bench of adaptation: every method on scans and on surfaces.

Paper: main table of adaptation methods of QS³ (ECCV 2022), whose figures stand beside ours.
"""

from qs3.experiments.experiment import Experiment, lines, tasks
from qs3.experiments.runs import PAPER, SUPERVISED

_ROWS = (
    SUPERVISED,
    "source-only",
    "pointdan",
    "defrec",
    "defrec-pcm",
    "gast",
    "gast-spst",
    "qbst",
    PAPER,
    "qbst-gentle",
    # The paper's table lacks these.
    "dann",
    "spst",
)
_PAIRS = (
    ("S over M on D", "S-D", "M-D"),
    ("S over M on R", "S-R", "M-R"),
    ("S over M on U", "S-U", "M-U"),
    *((f"QBST over {row}", "qbst", row) for row in _ROWS if row not in (SUPERVISED, "qbst")),
)

EXPERIMENT = Experiment(
    title="Adaptation bench",
    rows=lambda scale: lines({row: row for row in _ROWS}),
    columns=lambda scale: tasks(
        ("M", "D"), ("S", "D"), ("M", "R"), ("S", "R"), ("M", "U"), ("S", "U")
    ),
    published="methods",
    pairs=lambda scale: _PAIRS,
    corner="method",
    made=("M", "S", "D", "R"),
    usual=lambda scale: scale.tasks,
)
