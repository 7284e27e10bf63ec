"""Galleries: clouds of each class, domain by domain.

Paper: QS³ (ECCV 2022), supplement, Figs. 3 and 4: simulated and real clouds by class.
Command: ``qs3 reproduce galleries --out DIR`` (minutes: scans alone).
No figures are published. Procedural shapes alone are shown, which anybody may print.
"""

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Int

from qs3.experiments.domains import Domain, domain
from qs3.experiments.grid import DATA
from qs3.experiments.runs import Run
from qs3.experiments.setup import Setup
from qs3.io import load_clouds
from qs3.report.clouds import gallery, samples_per_class
from qs3.report.figure import write_png

GALLERIES = "galleries"
_DOMAINS = ("M", "S", "D", "F")
_PER_CLASS = 4


@dataclass(frozen=True)
class Galleries:
    """Pictures of the domains; one of the parts of `qs3.experiments.reproduction`."""

    setup: Setup
    """Where and how large."""
    name: str = GALLERIES
    """Name of the folder of pictures."""

    def runs(self) -> list[Run]:
        """Return no runs."""
        return []

    def sets(self) -> list[str]:
        """Return the data sets that are shown."""
        found = (domain(name, self.setup.own) for name in _DOMAINS)
        return [one.train for one in found if not one.own]

    def write(self) -> Path:
        """Draw each domain, and return the folder of the pictures."""
        folder = self.setup.out / self.name
        for name in _DOMAINS:
            one = domain(name, self.setup.own)
            clouds = load_clouds(
                _place(one, self.setup.out),
                split=one.train_split,
                cloud=one.cloud,
                num_points=self.setup.scale.train.num_points,
            )
            shown = clouds if one.own else clouds.select(_procedural(clouds.ids))
            samples = samples_per_class(shown.points, shown.labels, shown.class_names, _PER_CLASS)
            write_png(folder / f"{name}.png", gallery(samples, one.title))
        return folder


def _place(one: Domain, out: Path) -> Path:
    return Path(one.train) if one.own else out / DATA / one.train


def _procedural(ids: tuple[str, ...]) -> Int[np.ndarray, "s"]:
    """Return the rows of procedural shapes; an artist's mesh has the name of its file."""
    return np.flatnonzero([name.startswith("shapes/") for name in ids])
