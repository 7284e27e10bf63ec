"""Settings of `find`, and its answer: the parts of a picture, and what stays unexplained."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float

from qs3.checks import Share, check
from qs3.objects.segment import SegmentSettings
from qs3.parts.symmetry import Symmetry

LEAST = 40
"""Pixels of a part at least."""
GAP = 0.01
"""Metres between clusters; parts that are nearer are told apart by their CAD."""
_STILL, _ALIKE = 0.01, 0.25
"""Metres by which a rest may move, and share of its points that may come or go, to be the same."""


@dataclass(frozen=True)
class FindSettings:
    """Settings of the search in a picture."""

    far: float = float("inf")
    """Depths at or beyond are dropped, metres."""
    gravity: tuple[float, float, float] | None = None
    """Approximate downward direction in the camera's axes; None finds it from the table."""
    height: float = 0.5
    """Largest height of parts above the table, metres."""
    min_points: int = LEAST
    """Clusters of fewer points are left out."""
    least_score: Share = 0.5
    """Parts of a lower score are left unexplained. A part of the last frame stays until its
    score falls below half of it, so that it does not come and go with the noise."""

    def __post_init__(self) -> None:
        check(self, "find")
        _ = self.cutting

    @property
    def cutting(self) -> SegmentSettings:
        """How the picture is cut."""
        return SegmentSettings(
            far=self.far, gravity=self.gravity, height=self.height, gap=GAP,
            min_points=self.min_points,
        )  # fmt: skip


@dataclass(frozen=True)
class FoundPart:
    """One part of a picture."""

    class_name: str
    cad: str
    """Id of the CAD file in its folder."""
    pose: Float[np.ndarray, "4 4"]
    """Camera from part, metres: the vertices of the file as it stands on disk, times `scale`, to
    OpenCV's axes. Of all poses that look the same it is the one that is turned least; of a part of
    the last frame the one nearest to its pose there."""
    score: float
    """Probability that class and pose are right, as measured on simulated scenes of other parts;
    the confidence of `qs3.answers` is that of the class alone."""
    residual: float
    """Metres: root mean square distance of the part's pixels from its surface, along the normal."""
    continued: float
    """Share of the outline beyond which the measured surface simply goes on: high for a part that
    was seen into something larger."""
    rival: float
    """How well another part or pose explains the same pixels, by how well this one does; 0 if none
    does."""
    visible: float
    """Share of the surface towards the camera that the picture shows; the rest is hidden."""
    points: int
    """Pixels that lie on the part."""
    symmetry: Symmetry
    """Of the CAD: ``pose @ equals`` are the poses that look the same."""
    scale: float = 1.0
    """How many times larger the part is than its file, as ``qs3 adapt --tolerance`` found it."""


@dataclass(frozen=True)
class Unexplained:
    """A cluster, or a rest of one, that no part of the library explains."""

    points: int
    centre: tuple[float, float, float]
    """Middle of its points in the camera's axes, metres."""
    size: float
    """Metres from its middle to the farthest point, twice."""
    doubted: bool = False
    """Whether a part was found there with a score from half of the least one up; the next frame is
    searched there again, even if nothing changed."""

    @classmethod
    def of(cls, points: Float[np.ndarray, "n 3"], doubted: bool = False) -> "Unexplained":
        """Describe points in the camera's axes."""
        middle = np.median(points, axis=0)
        x, y, z = middle.tolist()
        away = np.linalg.norm(points - middle, axis=1)
        return cls(len(points), (x, y, z), 2 * float(away.max()), doubted)

    def is_still(self, other: "Unexplained") -> bool:
        """Return whether another, of the next frame, is where this is and about as large."""
        moved = np.linalg.norm(np.subtract(other.centre, self.centre))
        return bool(moved < _STILL and abs(self.points - other.points) < _ALIKE * self.points)


@dataclass(frozen=True)
class FoundParts:
    """Answer for one picture."""

    parts: tuple[FoundPart, ...]
    """Highest score first."""
    unexplained: tuple[Unexplained, ...]
    """Largest first."""
    camera_from_table: Float[np.ndarray, "4 4"] | None
    """The table is z = 0 and z is up; None for a bin so full that no table is seen."""
    side: Unexplained | None = None
    """The table, if it may be a side of a part and the search for that part found none; the next
    frame is searched for it only if the table changed."""
