"""Does a classifier trained on one sensor's scans work on another's?

Not in the paper. One view of the same meshes by each sensor; scored on other meshes.
"""

from itertools import combinations

from qs3.paper.cells import ORDINARY
from qs3.paper.experiment import Experiment, Heading
from qs3.paper.scales import Scale


def experiment(scale: Scale) -> Experiment:
    """Return the sensor of the training as rows, of the scored scans as columns."""
    rows, columns = (
        tuple(
            Heading(name, f"{what} on {name}", {domain: "A", f"{domain}_sensor": name})
            for name in scale.sensors
        )
        for what, domain in (("trained", "source"), ("scored", "target"))
    )
    return Experiment(
        title="Transfer between sensors",
        source="not in the paper",
        rows=rows,
        columns=columns,
        fields={"row": ORDINARY},
        pairs=[(f"trained on {a} over {b}", a, b) for a, b in combinations(scale.sensors, 2)],
        corner="source",
    )
