"""Does a classifier trained on one sensor's scans work on another's?

Not in the paper. One view of the same meshes by each sensor; scored on other meshes.
"""

import itertools

from qs3.experiments.domains import Domain
from qs3.experiments.experiment import Experiment, Heading, Headings
from qs3.experiments.runs import ORDINARY
from qs3.experiments.scales import Scale


def _headings(scale: Scale, what: str, domain: str) -> Headings:
    return tuple(
        Heading(name, f"{what} on {name}", {domain: Domain("A", sensor=name)})
        for name in scale.sensors
    )


EXPERIMENT = Experiment(
    title="Transfer between sensors",
    source="not in the paper",
    rows=lambda scale: _headings(scale, "trained", "source"),
    columns=lambda scale: _headings(scale, "scored", "target"),
    fields={"row": ORDINARY},
    pairs=lambda scale: [
        (f"trained on {name} over {other}", name, other)
        for name, other in itertools.combinations(scale.sensors, 2)
    ],
    corner="source",
)
