"""One view of a scan: its pictures, and the part of them that becomes points."""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Bool, Float, Float32, Shaped, UInt

from qs3.sensor.depth import backproject, gate
from qs3.sensor.presets import Sensor
from qs3.sensor.rig import Pose, Region
from qs3.sensor.statistics import EMPTY_VIEW, ViewStatistics, view_statistics

RIM = 16
"""Pixels around the object's box that are matched too: fattening reaches half a block."""


@dataclass(frozen=True)
class ViewImages:
    """The pictures of one view, all of the same part of the left frame."""

    region: Region
    """That part."""
    left: UInt[np.ndarray, "h w"]
    """Exposed left image."""
    right: UInt[np.ndarray, "h w"]
    """Exposed right image, the same columns of its frame; the stored pattern as the projector's
    camera sees it where the rig has no second camera."""
    disparity: Float32[np.ndarray, "h w"]
    """Disparity in pixels, NaN where none."""
    depth: Float[np.ndarray, "h w"]
    """Depth after the gate, NaN where none."""
    true_depth: Float[np.ndarray, "h w"]
    """Depth of the z-buffer of the whole scene, NaN where the ray misses everything."""
    mask: Bool[np.ndarray, "h w"]
    """Pixels that show the object."""
    silhouette: Bool[np.ndarray, "h w"] | None = None
    """Pixels that would show the object if it stood alone; with whole frames only."""
    normals: Float[np.ndarray, "h w 3"] | None = None
    """Normals in the camera's axes, NaN where nothing is; with whole frames only."""

    def true_object(self, sensor: Sensor) -> Float[np.ndarray, "h w"]:
        """True depth of the object where it is seen within the depth gate, NaN elsewhere."""
        return gate(np.where(self.mask, self.true_depth, np.nan), sensor.depth)

    def blind(self, sensor: Sensor) -> bool:
        """Whether no pixel shows the object within the depth gate: what is matched is not it."""
        return not np.isfinite(self.true_object(sensor)).any()

    def part(self, image: Shaped[np.ndarray, "h w"], part: Region) -> Shaped[np.ndarray, "h2 w2"]:
        """The pixels of ``part`` of the frame, which lies within ``region``."""
        x, y = part.x - self.region.x, part.y - self.region.y
        return image[max(y, 0) : y + part.height, max(x, 0) : x + part.width]


def object_region(bounds: Float[np.ndarray, "2 3"], sensor: Sensor, pose: Pose) -> Region:
    """The part of the left frame that is matched for the object's sake."""
    return sensor.rig.region_of(bounds, pose, RIM)


def clouds_of(
    images: ViewImages, part: Region, pose: Pose, sensor: Sensor, mask_crop: bool
) -> tuple[Float[np.ndarray, "n 3"], Float[np.ndarray, "m 3"]]:
    """The noisy and the true points of one view, in the world.

    A view that does not show the object within the depth gate gives none: what its matcher found
    is something else.

    Args:
        images: The pictures.
        part: The object's part of the frame.
        pose: Left camera.
        sensor: Grid and depth gate.
        mask_crop: Keep the pixels that show the object only.
    """
    if images.blind(sensor):
        return np.zeros((0, 3)), np.zeros((0, 3))
    depth = np.where(images.mask, images.depth, np.nan) if mask_crop else images.depth

    def lift(image: Float[np.ndarray, "h w"]) -> Float[np.ndarray, "n 3"]:
        return backproject(images.part(image, part), sensor.rig, part, pose, sensor.depth)

    return lift(depth), lift(images.true_object(sensor))


def statistics_of(images: ViewImages, part: Region, sensor: Sensor) -> ViewStatistics:
    """Measure a view on the object's part of the frame; all None where it does not show it."""
    if images.blind(sensor):
        return EMPTY_VIEW
    return view_statistics(
        images.part(images.disparity, part),
        images.part(images.true_depth, part),
        sensor.rig,
        images.part(images.mask, part),
    )
