"""Does a classifier trained on one sensor's scans work on another's?

Not in the paper. One view of the same meshes by each sensor; scored on other meshes.
Command: ``qs3 reproduce sensors --out DIR`` (``--dry-run`` prints the hours on this machine).
"""

from qs3.experiments.domains import sensor_domain
from qs3.experiments.experiment import Experiment, Named, Place
from qs3.experiments.rows import ORDINARY
from qs3.experiments.runs import Run, make_run
from qs3.experiments.scales import Scale


def _rows(scale: Scale) -> Named:
    return tuple((name, f"trained on {name}") for name in scale.sensors)


def _columns(scale: Scale) -> Named:
    return tuple((name, f"scored on {name}") for name in scale.sensors)


def _run(scale: Scale, row: str, column: str, seed: int, threads: int | None) -> Run:
    task = f"{sensor_domain(row)}-{sensor_domain(column)}"
    return make_run(scale, task, ORDINARY, seed, threads)


def _pairs(scale: Scale) -> list[tuple[str, Place, Place]]:
    return [
        (f"own sensor over {other}, scored on {name}", (name, name), (other, name))
        for name in scale.sensors
        for other in scale.sensors
        if other != name
    ]


EXPERIMENT = Experiment(
    name="sensors",
    title="Transfer between sensors",
    source="not in the paper",
    rows=_rows,
    columns=_columns,
    run=_run,
    pairs=_pairs,
    corner="DGCNN",
)
"""A table that the paper lacks."""
