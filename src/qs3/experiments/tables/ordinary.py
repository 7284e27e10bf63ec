"""Networks without adaptation: does training on scans beat training on surfaces?

Paper: QS³ (ECCV 2022), main table of ordinary classification, Sim2Real: M→D, S→D, M→S*, S→S*.
Published: S over M on D +12.5, +17.3, +4.2, +7.7 points for the four networks.
"""

from qs3.experiments.domains import Kind
from qs3.experiments.experiment import Experiment, networks, tasks
from qs3.experiments.runs import ORDINARY

_SOURCES: tuple[Kind, ...] = ("M", "S", "S+C+M")
_TARGETS: tuple[Kind, ...] = ("D", "F", "R", "U")
_TASKS: list[tuple[Kind, Kind]] = [(s, t) for t in _TARGETS for s in _SOURCES]

EXPERIMENT = Experiment(
    title="Networks without adaptation, simulation to target",
    rows=networks,
    columns=lambda scale: tasks(*_TASKS),
    fields={"row": ORDINARY},
    published="ordinary",
    pairs=lambda scale: [
        (f"{source} over M on {target}", f"{source}-{target}", f"M-{target}")
        for target in _TARGETS
        for source in _SOURCES[1:]
    ],
    usual=lambda scale: scale.sources,
)
