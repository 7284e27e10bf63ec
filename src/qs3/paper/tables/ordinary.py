"""Networks without adaptation: does training on scans beat training on surfaces?

Paper: QS³ (ECCV 2022), main table of ordinary classification, Sim2Real: M→D, S→D, M→S*, S→S*.
Published: S over M on D +12.5, +17.3, +4.2, +7.7 points for the four networks.
"""

from itertools import product

from qs3.paper.cells import ORDINARY
from qs3.paper.experiment import Experiment, networks, tasks
from qs3.paper.scales import Scale


def experiment(scale: Scale) -> Experiment:
    """Return networks as rows, sources and targets as columns."""
    return Experiment(
        title="Networks without adaptation, simulation to target",
        rows=networks(scale),
        columns=tasks(*((s, t) for t, s in product("DFRU", ("M", "S", "S+C+M")))),
        fields={"row": ORDINARY},
        published="ordinary",
        pairs=[
            (f"{source} over M on {target}", f"{source}-{target}", f"M-{target}")
            for target, source in product("DFRU", ("S", "S+C+M"))
        ],
        usual=scale.sources,
    )
