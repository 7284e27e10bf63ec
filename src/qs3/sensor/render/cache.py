"""What the two irradiance caches share: their settings, their cells and where rays go."""

import math
from dataclasses import dataclass

import numpy as np
from jaxtyping import Float32

from qs3.errors import InputError
from qs3.sensor.rig import Region

# Roberts (2018), the plane's counterpart of the golden ratio: multiples of it, without their whole
# part, cover the unit square evenly, however many are taken.
R2 = (0.7548776662466927, 0.5698402909980532)
GOLDEN = (math.sqrt(5) - 1) / 2
TRIES = 12  # places in a cell that are tried for one that shows a surface


def places(samples: int) -> Float32[np.ndarray, "n 2"]:
    """Where in a pixel its rays go, in 0…1: a Latin square, whose mean is the pixel's centre.

    Example:
        >>> places(4).tolist()
        [[0.125, 0.125], [0.375, 0.625], [0.625, 0.375], [0.875, 0.875]]
    """
    ranks = np.argsort(np.argsort(np.arange(samples) * GOLDEN % 1))
    both = np.stack([np.arange(samples), ranks], axis=1)
    return ((both + 0.5) / samples).astype(np.float32)


@dataclass(frozen=True)
class CacheSettings:
    """How finely the soft light is gathered."""

    cell: int = 4
    """Side in pixels of a cell."""
    rays: int = 32
    """Rays over the hemisphere in each cell."""
    smoothing: int = 1
    """Cells on either side that are averaged with a cell, where position and normal agree."""

    def __post_init__(self) -> None:
        if self.cell < 1 or self.rays < 1 or self.smoothing < 0:
            raise InputError(
                f"renderer: cell {self.cell} and rays {self.rays} must be at least 1, smoothing "
                f"{self.smoothing} not below 0"
            )


def cells(region: Region, cell: int) -> Region:
    """The region grown to whole cells of the frame, so that a cell is one in every region.

    Example:
        >>> cells(Region(3, 5, 10, 8), 4)
        Region(x=0, y=4, width=16, height=12)
    """
    x, y = region.x // cell * cell, region.y // cell * cell
    columns = max(1, -(-(region.x + region.width - x) // cell))
    rows = max(1, -(-(region.y + region.height - y) // cell))
    return Region(x, y, columns * cell, rows * cell)
