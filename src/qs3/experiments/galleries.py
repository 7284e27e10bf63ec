"""Galleries: clouds of each class, domain by domain.

Paper: QS³ (ECCV 2022), supplement, Figs. 3 and 4: simulated and real clouds by class.
Command: ``qs3 reproduce galleries --out DIR`` (minutes: scans alone).
No figures are published. Procedural shapes alone are shown, which anybody may print.
"""

from pathlib import Path

import numpy as np

from qs3.experiments import GALLERIES
from qs3.experiments.domains import DataSet, Domain, DomainData, Kind, data_of
from qs3.experiments.setup import Setup
from qs3.io import load_clouds
from qs3.report.clouds import gallery
from qs3.report.figure import write_png

_KINDS: tuple[Kind, ...] = ("M", "S", "D", "F")
_PER_CLASS = 4


def _domains(setup: Setup) -> dict[Kind, DomainData]:
    return {kind: data_of(Domain(kind), setup.own) for kind in _KINDS}


def shown(setup: Setup) -> list[DataSet]:
    """Return the data sets that the galleries need."""
    sets = [domain.train.data for domain in _domains(setup).values()]
    return [data for data in sets if isinstance(data, DataSet)]


def draw_galleries(setup: Setup) -> Path:
    """Draw each domain, and return the folder of the pictures."""
    folder = setup.out / GALLERIES
    for kind, domain in _domains(setup).items():
        clouds = load_clouds(
            domain.train.locate(setup.out, setup.shared),
            split=domain.train.split,
            cloud=domain.train.cloud,
            num_points=setup.scale.train.num_points,
        )
        if not domain.own:  # an artist's mesh has the name of its file
            procedural = [name.startswith("shapes/") for name in clouds.ids]
            clouds = clouds.select(np.flatnonzero(procedural))
        samples = {
            name: list(clouds.points[clouds.labels == label][:_PER_CLASS])
            for label, name in enumerate(clouds.class_names)
        }
        write_png(folder / f"{kind}.png", gallery(samples, domain.title))
    return folder
