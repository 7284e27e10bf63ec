"""Networks trained on the target and scored on simulations: which simulation is closer?

Paper: QS³ (ECCV 2022), supplement, Table 1 (Real2Sim): D→M and D→S for four networks.
Published: D→S over D→M +14.9, +11.4, +13.0, +5.0 points.
"""

from qs3.paper.cells import ORDINARY
from qs3.paper.experiment import Experiment, networks, tasks
from qs3.paper.scales import Scale


def experiment(scale: Scale) -> Experiment:
    """Return networks as rows, simulations as columns."""
    return Experiment(
        title="Networks trained on the target, scored on simulations",
        rows=networks(scale),
        columns=tasks(("D", "M"), ("D", "S")),
        fields={"row": ORDINARY},
        published="real2sim",
        pairs=[("S over M", "D-S", "D-M")],
    )
