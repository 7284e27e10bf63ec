"""Galleries: clouds of each class, domain by domain.

Paper: QS³ (ECCV 2022), supplement, Figs. 3 and 4: simulated and real clouds by class.
Command: ``qs3 reproduce galleries --out DIR`` (minutes: scans alone).
No figures are published. Procedural shapes alone are shown, which anybody may print.
"""

from pathlib import Path

import numpy as np

from qs3.clouds.load import load_clouds
from qs3.paper import GALLERIES
from qs3.paper.domains import Generated, Kind, find_domain
from qs3.paper.setup import Setup
from qs3.report.clouds import gallery
from qs3.report.figure import write_png

_KINDS: tuple[Kind, ...] = ("M", "S", "D", "F")
_PER_CLASS = 4


def shown(setup: Setup) -> list[Generated]:
    """Return the data sets that the galleries need."""
    sets = [find_domain(kind, setup.data).train.data for kind in _KINDS]
    return [data for data in sets if not isinstance(data, Path)]


def draw_galleries(setup: Setup) -> Path:
    """Draw each domain, and return the folder of the pictures."""
    for kind in _KINDS:
        domain = find_domain(kind, setup.data)
        part, points = domain.train, setup.scale.train.num_points
        place = part.locate(setup.out, setup.shared)
        clouds = load_clouds(place, split=part.split, cloud=part.cloud, num_points=points)
        if not domain.is_users:  # an artist's mesh has the name of its file
            procedural = [name.startswith("shapes/") for name in clouds.ids]
            clouds = clouds.select(np.flatnonzero(procedural))
        samples = {
            name: list(clouds.points[clouds.labels == label][:_PER_CLASS])
            for label, name in enumerate(clouds.class_names)
        }
        write_png(setup.out / GALLERIES / f"{kind}.png", gallery(samples, domain.title))
    return setup.out / GALLERIES
