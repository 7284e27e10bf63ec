"""How objects are cut from scenes of ScanNet."""

from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import numpy as np

from qs3.errors import InputError
from qs3.io.extract.run import wanted_classes
from qs3.sensor.checks import check_range


@dataclass(frozen=True)
class ScanNetSettings:
    """How objects are cut from scenes of ScanNet."""

    from_mesh: bool = False
    """From the fused mesh, as ScanNet10, and not from the depth frames."""
    scenes: tuple[str, ...] = ()
    """Only these scenes; all by default."""
    splits_train: Path | None = None
    """The list of training scenes, such as scannetv2_train.txt."""
    splits_test: Path | None = None
    """The list of test scenes, such as scannetv2_val.txt."""
    classes: tuple[str, ...] = ("pointda10",)
    """Classes to map the objects onto, pointda10 for its ten; others are dropped."""
    every: int = 10
    """Step between the depth frames that are read; ScanNet has 30 a second."""
    near: float = 0.4
    """Smallest depth kept, metres: the Structure sensor's own limit."""
    far: float = 4.0
    """Largest depth kept, metres: beyond it the sensor's noise passes 3 cm."""
    cut: Literal["auto", "masks", "mesh"] = "auto"
    """By the instance masks of the frames, or by nearness to the annotated mesh; auto takes the
    masks if the scene has them."""
    erode: int = 2
    """Pixels of the depth image by which masks shrink: as far as they miss the depth's edges."""
    distance: float = 0.05
    """Largest distance of a point to a mesh vertex of its object, metres. Vertices lie 1 to 2 cm
    apart and depth noise is 1.5 cm at 3 m: less would cut the noise off."""
    voxel: float = 0.01
    """Edge of the voxels that keep one measured point each, metres."""
    max_points: int = 20_000
    """Points of an object kept before the data set's own sampling."""
    max_frames: int = 20
    """Frames fused to an object, drawn at random from those that see it; 0 fuses all."""
    min_pixels: int = 200
    """Pixels of an object that a frame needs to count."""
    min_points: int = 512
    """Objects with fewer points are dropped."""
    seed: int = 0
    """Seed of every choice."""

    def __post_init__(self) -> None:
        check_range(self, "scannet", "erode", "max_frames", "seed")
        check_range(self, "scannet", "every", "max_points", "min_pixels", "min_points", low=1)
        check_range(self, "scannet", "distance", "voxel", low=1e-4, high=1)
        if not 0 <= self.near < self.far < np.inf:
            raise InputError(f"near {self.near}, far {self.far}: need 0 ≤ near < far, metres")
        if wanted_classes(self.classes) is None:
            raise InputError("--classes all: ScanNet's labels are free words; name the classes")

    @property
    def class_names(self) -> tuple[str, ...]:
        """The classes by their names."""
        return wanted_classes(self.classes) or ()
