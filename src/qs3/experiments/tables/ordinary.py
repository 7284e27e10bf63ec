"""Networks without adaptation: does training on scans beat training on surfaces?

Paper: QS³ (ECCV 2022), main table of ordinary classification, Sim2Real: M→D, S→D, M→S*, S→S*.
Published: S over M on D +12.5, +17.3, +4.2, +7.7 points for the four networks.
"""

from qs3.experiments.experiment import Experiment, networks, tasks
from qs3.experiments.runs import ORDINARY

EXPERIMENT = Experiment(
    title="Networks without adaptation, simulation to target",
    rows=networks,
    columns=lambda scale: tasks(("M", "D"), ("S", "D"), ("M", "F"), ("S", "F")),
    fields={"row": ORDINARY},
    published="ordinary",
    pairs=lambda scale: [("S over M on D", "S-D", "M-D"), ("S over M on F", "S-F", "M-F")],
)
"""The paper's main table."""
