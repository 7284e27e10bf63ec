"""A real infrared pair with its camera's own depth, from files."""

from dataclasses import dataclass
from pathlib import Path
from typing import Annotated

import numpy as np

from qs3.checks import Option
from qs3.errors import InputError
from qs3.files import sha256
from qs3.frames.camera_files import read_intrinsics
from qs3.frames.images import read_depth, read_infrared
from qs3.sensor.realism import InfraredPair


@dataclass(frozen=True)
class PairFiles:
    """A real camera's infrared pair and its own depth, to hold the sensor's matcher against."""

    pair: Annotated[tuple[Path, Path], Option(metavar="LEFT RIGHT")]
    """Left and right infrared image of a real camera, rectified, of 8 or 16 bits."""
    depth: Path
    """The camera's own depth in the left image's frame: 16-bit PNG, TIFF or npy."""
    intrinsics: str
    """Intrinsics of the left image: fx,fy,cx,cy; a JSON or YAML file of a camera; or a text file of
    3×3 numbers."""
    baseline: float
    """Metres between the two infrared cameras."""
    depth_scale: float | None = None
    """Metres per step of the depth; default: the camera's, else 0.001 for integers and 1 for other
    numbers."""

    def checksums(self) -> dict[str, dict[str, str]]:
        """Return name (not the path) and SHA-256 of each image, for records."""
        left, right = self.pair
        paths = {"left": left, "right": right, "depth": self.depth}
        return {n: {"name": p.name, "sha256": sha256(p)} for n, p in paths.items()}

    def read(self) -> InfraredPair:
        """Read the pair; 16 bits are brought to the 10 that cameras have."""
        left, right = map(read_infrared, self.pair)
        if left.dtype != right.dtype:
            raise InputError(f"{self.pair[1]}: is {right.dtype}, {self.pair[0]} {left.dtype}")
        if left.dtype == np.uint16:
            spare = max(0, int(max(left.max(), right.max())).bit_length() - 10)
            left, right = left >> spare, right >> spare
        camera = read_intrinsics(self.intrinsics, self.depth_scale)
        if camera.distortion:
            raise InputError(f"{self.intrinsics}: has lens distortion; rectify the pair")
        camera.check_size(left.shape, str(self.pair[0]))
        depth = read_depth(self.depth, camera.depth_scale)
        for path, image in ((self.pair[1], right), (self.depth, depth)):
            if image.shape != left.shape:
                (high, wide), (height, width) = image.shape, left.shape
                raise InputError(
                    f"{path}: is {wide}×{high} pixels, {self.pair[0]} {width}×{height}; both "
                    "images have one size, and so has the depth, in the left image's frame"
                )
        return InfraredPair(left, right, depth.astype(np.float64), camera.fx, self.baseline)
