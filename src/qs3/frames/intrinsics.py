"""The pinhole camera that took a depth image."""

import math
from dataclasses import astuple, dataclass

import numpy as np
from jaxtyping import Float

from qs3.errors import InputError, say_once
from qs3.frames.images import check_scale
from qs3.reading import naming

_OFF = (0.82, 1.22)
"""Least and largest place of a principal point, 1 in the middle. Of the cameras that we know the
Azure Kinect is the farthest off, with 1.17; the K of 848 pixels has 1.33 in an image of 640."""
_CORNER = 0.05
"""From which place on it lies in the image, and is no share of its size or 0 for unknown."""
_OBLONG = 3.0
"""Greatest ratio of fx and fy: pixels are square, and images are seldom stretched."""
_AT = 0.1
"""Part of half an image by which a principal point is off the middle at most, of most cameras."""
_SHAPES = (4 / 3, 16 / 10, 16 / 9)
"""Width by height of the modes of cameras; of those of one width some are cut off at the others."""
_OTHER, _SAME = 0.08, 0.03
"""The same part from which on it may be that of another mode, and below which it is."""


@dataclass(frozen=True)
class Intrinsics:
    """A pinhole camera in pixels, with the distortion of its lens if images are not rectified.

    Convention:
        Pixel (0, 0) is the centre of the top-left pixel: a point (x, y, z) of the OpenCV camera
        is seen at u = fx·x/z + cx, v = fy·y/z + cy.
    """

    fx: float
    fy: float
    cx: float
    cy: float
    width: int | None = None
    height: int | None = None
    depth_scale: float | None = None
    """Metres per step of its depth images; None if unknown."""
    distortion: tuple[float, ...] = ()
    """Coefficients of the lens in OpenCV's order; empty if there is no distortion."""

    def __post_init__(self) -> None:
        if not all(map(math.isfinite, (self.fx, self.fy, self.cx, self.cy, *self.distortion))):
            raise InputError("camera: fx, fy, cx, cy and distortion must be finite numbers")
        if self.fx <= 0 or self.fy <= 0:
            raise InputError(
                f"camera: focal lengths fx {self.fx:g} and fy {self.fy:g} must be positive pixels"
            )
        if self.depth_scale is not None:
            with naming("camera"):
                check_scale(self.depth_scale)

    @property
    def matrix(self) -> Float[np.ndarray, "3 3"]:
        """K."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1]])

    def is_like(self, other: "Intrinsics") -> bool:
        """Return whether another camera is the same to a thousandth, in what both know."""
        pairs = zip(astuple(self)[:7], astuple(other)[:7], strict=True)
        known = [pair for pair in pairs if None not in pair]
        return all(math.isclose(one, two, rel_tol=1e-3) for one, two in known)

    def check_size(self, shape: tuple[int, ...], where: str) -> None:
        """Refuse an image that this camera did not take; ``where`` names it.

        A camera of unknown size is judged by its principal point, which lies near the middle.
        """
        height, width = shape[:2]
        image = f"{where}: is {width}×{height} pixels"
        if (self.width or width, self.height or height) != (width, height):
            raise InputError(
                f"{image}, the camera {self.width}×{self.height}; give the intrinsics of this image"
            )
        if not (0.1 < self.fx / width < 100 and 1 / _OBLONG < self.fx / self.fy < _OBLONG):
            raise InputError(
                f"{image}, and fx {self.fx:g}, fy {self.fy:g} are no focal lengths of it in pixels;"
                " multiply those in millimetres by the pixels in a millimetre, normalised ones by "
                "the width and the height"
            )
        places = (2 * self.cx + 1) / width, (2 * self.cy + 1) / height
        turned = (2 * self.cy + 1) / width, (2 * self.cx + 1) / height
        if max(abs(place - 1) for place in turned) < _AT < min(abs(place - 1) for place in places):
            say_once(f"{where}: is cx {self.cx:g}, and cy {self.cy:g}? The middle is the reverse")
        if self.width is None and not (min(places) > _OFF[0] and max(places) < _OFF[1]):
            raise InputError(
                f"{image}, and the camera's principal point {self.cx:g}, {self.cy:g} is not near "
                "their middle; give the intrinsics of this size, or if it is a crop, write its "
                "width and height into the camera's file"
            )
        fault = f"{image}, and the camera's principal point {self.cx:g}, {self.cy:g} is"
        if not (min(places) > _CORNER and max(places) < 2 - _CORNER):
            say_once(
                f"{fault} not in it; if the image is no crop, give the intrinsics of this size"
            )
            return
        off = max(abs(place - 1) for place in places)
        modes: list[tuple[int, int]] = []
        if off > _AT and abs(places[0] - places[1]) < _SAME:  # of the same shape
            modes = [(round(2 * self.cx + 1), round(2 * self.cy + 1))]
        elif self.width is None and off > _OTHER:
            modes = [
                mode
                for ratio in _SHAPES
                for mode in ((width, round(width / ratio)), (round(height * ratio), height))
            ]
        for w, h in modes:
            if max(abs((2 * self.cx + 1) / w - 1), abs((2 * self.cy + 1) / h - 1)) < _SAME:
                say_once(
                    f"{fault} the middle of {w}×{h}: are the intrinsics of this size?",
                    "principal point",
                )
