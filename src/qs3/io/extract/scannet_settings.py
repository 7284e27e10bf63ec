"""Settings of the extraction of objects from ScanNet's scenes."""

from dataclasses import dataclass
from typing import Literal

import numpy as np

from qs3.errors import InputError
from qs3.meshes.classes import POINTDA10


@dataclass(frozen=True)
class ScanNetSettings:
    """How objects are cut from scenes."""

    class_names: tuple[str, ...] = POINTDA10
    """Classes that are kept; labels are mapped onto them, others are dropped."""
    every: int = 10
    """Step between the depth frames that are read; ScanNet has 30 a second."""
    near: float = 0.4
    """Smallest depth kept, metres: the Structure sensor's own limit."""
    far: float = 4.0
    """Largest depth kept, metres: beyond it the sensor's noise passes 3 cm."""
    cut: Literal["auto", "masks", "mesh"] = "auto"
    """By the instance masks of the frames, or by nearness to the annotated mesh; auto takes the
    masks where the scene has them."""
    erode: int = 2
    """Pixels of the depth image by which masks shrink: as far as they miss the depth's edges."""
    distance: float = 0.05
    """Largest distance of a point to a mesh vertex of its object, metres. Vertices lie 1 to 2 cm
    apart and depth noise is 1.5 cm at 3 m: less would cut the noise off."""
    voxel: float = 0.01
    """Edge of the voxels that keep one measured point each, metres."""
    max_points: int = 20_000
    """Points of an object kept before the data set's own thinning."""
    max_frames: int = 20
    """Frames fused to an object, drawn at random from those that see it; 0 fuses all."""
    min_pixels: int = 200
    """Pixels of an object that a frame needs to count."""
    min_points: int = 512
    """Objects with fewer points are dropped."""
    mesh_points: int = 2048
    """Vertices drawn of an object of the fused mesh."""
    seed: int = 0
    """Seed of every choice."""

    def __post_init__(self) -> None:
        """Refuse settings out of range.

        Raises:
            InputError: naming the setting.
        """
        low = {"every": 1, "erode": 0, "max_points": 1, "max_frames": 0, "min_pixels": 1}
        low |= {"min_points": 1, "mesh_points": 1, "seed": 0}
        for name, least in low.items():
            if getattr(self, name) < least:
                raise InputError(f"{name} {getattr(self, name)}: has to be at least {least}")
        if not 0 <= self.near < self.far < np.inf:
            raise InputError(f"near {self.near}, far {self.far}: need 0 ≤ near < far, metres")
        for name in ("distance", "voxel"):
            if not 1e-4 <= getattr(self, name) <= 1:
                raise InputError(f"{name} {getattr(self, name)}: has to lie from 0.0001 to 1 m")
        if not self.class_names:
            raise InputError("class_names: name at least one class")
