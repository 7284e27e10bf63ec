"""Galleries: clouds of each class, domain by domain.

Paper: QS³ (ECCV 2022), supplement, Figs. 3 and 4: simulated and real clouds by class.
Command: ``qs3 reproduce galleries --out DIR`` (minutes: scans alone).
No figures are published. Procedural shapes alone are shown, which anybody may print.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from qs3.experiments import GALLERIES
from qs3.experiments.domains import DataSet, Domain, Kind, data_of
from qs3.experiments.runs import Run
from qs3.experiments.setup import Setup
from qs3.io import load_clouds
from qs3.report.clouds import gallery
from qs3.report.figure import write_png

_DOMAINS: tuple[Kind, ...] = ("M", "S", "D", "F")
_PER_CLASS = 4


@dataclass(frozen=True)
class Galleries:
    """Pictures of the domains; one of the parts of `qs3.experiments.reproduce`."""

    setup: Setup
    """Where and how large."""
    name: str = GALLERIES
    """Name of the folder of pictures."""

    def runs(self) -> list[Run]:
        """Return no runs."""
        return []

    def sets(self) -> list[DataSet]:
        """Return the data sets that are shown."""
        shown = [data_of(Domain(kind), self.setup.own).train.data for kind in _DOMAINS]
        return [data for data in shown if isinstance(data, DataSet)]

    def write(self) -> Path:
        """Draw each domain, and return the folder of the pictures."""
        folder = self.setup.out / self.name
        for kind in _DOMAINS:
            data = data_of(Domain(kind), self.setup.own)
            clouds = load_clouds(
                data.train.locate(self.setup.out, self.setup.shared),
                split=data.train.split,
                cloud=data.train.cloud,
                num_points=self.setup.scale.train.num_points,
            )
            shown = clouds
            if not data.own:  # an artist's mesh has the name of its file
                procedural = [name.startswith("shapes/") for name in clouds.ids]
                shown = clouds.select(np.flatnonzero(procedural))
            samples = {
                name: list(shown.points[shown.labels == label][:_PER_CLASS])
                for label, name in enumerate(shown.class_names)
            }
            write_png(folder / f"{kind}.png", gallery(samples, data.title))
        return folder
