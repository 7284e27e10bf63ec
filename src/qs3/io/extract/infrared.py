"""A real infrared pair with its camera's own depth, from files."""

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from qs3.errors import InputError
from qs3.files import sha256
from qs3.io.depth_images import read_depth, read_infrared
from qs3.io.extract.intrinsics import read_intrinsics
from qs3.sensor.realism.pair import InfraredPair


@dataclass(frozen=True)
class PairFiles:
    """A real camera's infrared pair and its own depth, to hold the sensor's matcher against."""

    pair: tuple[Path, Path] | None = None
    """Left and right infrared image of a real camera, rectified, 8 or 16 bits: the sensor's matcher
    is measured on them beside the camera's own depth, in place of the tests."""
    depth: Path | None = None
    """The camera's own depth in the left image's frame: 16-bit PNG, TIFF or npy."""
    intrinsics: str = ""
    """Of the left image: fx,fy,cx,cy; a JSON or YAML file of a camera; or a text file of 3×3
    numbers."""
    baseline: float | None = None
    """Metres between the two infrared cameras."""
    depth_scale: float | None = None
    """Metres a step of the depth; None takes the camera's, else 0.001 for whole numbers and 1 for
    others."""

    def __post_init__(self) -> None:
        given = (self.pair, self.depth, self.intrinsics, self.baseline)
        if any((*given, self.depth_scale)) and not all(given):
            raise InputError(
                "a real pair needs --pair LEFT RIGHT --depth DEPTH --intrinsics K --baseline "
                "METRES, all of them"
            )

    def checksums(self) -> dict[str, dict[str, str]]:
        """Name (not the path) and SHA-256 of each image, for records; empty without images."""
        left, right = self.pair or (None, None)
        paths = {"left": left, "right": right, "depth": self.depth}
        return {n: {"name": p.name, "sha256": sha256(p)} for n, p in paths.items() if p is not None}

    def read(self) -> InfraredPair | None:
        """Read the pair, None without files; 16 bits are brought to the 10 that cameras have."""
        if self.pair is None or self.depth is None or self.baseline is None:
            return None
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
