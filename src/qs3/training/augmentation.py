"""Augmentation of whole batches of clouds: the losses and gains of a scan, imitated.

The pure functions take what is drawn; `augment_clouds` draws it, as often and as far as the
`Augmentation` in `qs3.runs.settings` allows. Nothing depends on a cloud's unit: lengths are
relative to its robust box. The vertical is z.
"""

import math
from typing import NamedTuple

import torch
from jaxtyping import Bool, Float, Int
from torch import Tensor

from qs3.models.ops import gather_points
from qs3.models.wrappers import ball_radius
from qs3.runs.settings import Augmentation, TrainSettings

_OUTSIDE = 0.01
"""Share of the points beyond each side of the robust box."""
_MARGIN, _THICKNESS = 0.4, 0.02
"""Margin of a floor around the object, and its thickness, in radii."""
_HIGHEST = 0.7
"""Largest elevation of the camera, in radians."""
_CELLS = 0.62
"""Cells along the image of that camera, for each √n of a cloud's points: a few points per cell."""
_BEHIND = 0.12
"""Depth behind the nearest point that is still seen, in radii."""


class Box(NamedTuple):
    """The axis-parallel box about the middle 98 % of each cloud's coordinates."""

    low: Float[Tensor, "b 1 3"]
    high: Float[Tensor, "b 1 3"]

    @property
    def centre(self) -> Float[Tensor, "b 1 3"]:
        """The middle."""
        return (self.low + self.high) / 2

    @property
    def radius(self) -> Float[Tensor, "b 1 1"]:
        """Half the diagonal, the unit of all lengths."""
        return (self.high - self.low).norm(dim=2, keepdim=True) / 2


def robust_box(points: Float[Tensor, "b n 3"]) -> Box:
    """Return the box that single strays cannot move."""
    ordered, beyond = points.sort(dim=1).values, int(_OUTSIDE * points.shape[1])
    return Box(ordered[:, beyond, None], ordered[:, points.shape[1] - 1 - beyond, None])


def lose_highest(
    kept: Bool[Tensor, "b n"], score: Float[Tensor, "b n"], count: Int[Tensor, "b 1"], least: float
) -> Bool[Tensor, "b n"]:
    """Return which points are kept after ``count`` of the highest score are lost.

    Fewer are lost if less than a share ``least`` of all points would stay.
    """
    left = kept.sum(dim=1, keepdim=True) - math.ceil(least * kept.shape[1])
    order = score.masked_fill(~kept, -torch.inf).argsort(dim=1, descending=True, stable=True)
    place = torch.arange(kept.shape[1], device=kept.device)
    lost = torch.zeros_like(kept).scatter(1, order, place < torch.minimum(count, left))
    return kept & ~lost


def in_sight(
    points: Float[Tensor, "b n 3"], azimuth: Float[Tensor, "b 1"], elevation: Float[Tensor, "b 1"]
) -> Bool[Tensor, "b n"]:
    """Return which points a camera far away sees: those not behind others, by a coarse depth image.

    The camera looks along +y from an elevation, at clouds turned about z by an azimuth; radians.
    """
    b, n, _ = points.shape
    turned_points = turned(points, azimuth)
    low, high = turned_points.amin(dim=1, keepdim=True), turned_points.amax(dim=1, keepdim=True)
    x, y, z = (turned_points - (low + high) / 2).unbind(2)
    depth = elevation.cos() * y - elevation.sin() * z
    up = elevation.sin() * y + elevation.cos() * z
    radius = ((high - low).norm(dim=2) / 2).clamp_min(torch.finfo(points.dtype).tiny)
    side = math.ceil(_CELLS * math.sqrt(n))
    column, row = (((along / radius + 1) / 2 * side).long().clamp(0, side - 1) for along in (x, up))
    cell = row * side + column
    image = depth.new_full((b, side * side), torch.inf).scatter_reduce(1, cell, depth, "amin")
    nearest = -torch.nn.functional.max_pool2d(-image.view(b, 1, side, side), 3, 1, 1)
    return depth <= nearest.view(b, -1).gather(1, cell) + _BEHIND * radius


def near_patch(
    points: Float[Tensor, "b n 3"], centres: Float[Tensor, "b k 3"]
) -> Float[Tensor, "b n"]:
    """Score points by how near the nearest of the centres is: −distance."""
    exact = "donot_use_mm_for_euclid_dist"
    return -torch.cdist(points, centres, compute_mode=exact).amin(dim=2)


def stretched(
    points: Float[Tensor, "b n 3"], centre: Float[Tensor, "b 1 3"], factor: Float[Tensor, "b 1 3"]
) -> Float[Tensor, "b n 3"]:
    """Stretch each axis by a factor, about the centre; factor 1 changes no bit."""
    return points + (factor - 1) * (points - centre)


def turned(points: Float[Tensor, "b n 3"], angle: Float[Tensor, "b 1"]) -> Float[Tensor, "b n 3"]:
    """Turn clouds about z.

    Convention:
        Anticlockwise seen from above, as `qs3.geometry.rotation_z`; radians.
    """
    c, s = angle.cos(), angle.sin()
    x, y, z = points.unbind(2)
    return torch.stack([c * x - s * y, s * x + c * y, z], dim=2)


def tilted(
    points: Float[Tensor, "b n 3"],
    centre: Float[Tensor, "b 1 3"],
    heading: Float[Tensor, "b 1"],
    angle: Float[Tensor, "b 1"],
) -> Float[Tensor, "b n 3"]:
    """Rotate clouds about a horizontal axis through the centre; angle 0 changes no bit.

    Convention:
        Right-handed about (cos h, sin h, 0), by Rodrigues' formula; radians.
    """
    axis = torch.stack([heading.cos(), heading.sin(), torch.zeros_like(heading)], dim=2)
    axis = axis.expand_as(points)
    across = torch.linalg.cross(axis, points - centre)
    along = torch.linalg.cross(axis, across)
    return points + angle.sin()[:, None] * across + (1 - angle.cos())[:, None] * along


def floor_beneath(
    box: Box, edges: Float[Tensor, "b 2 3"], uniform: Float[Tensor, "b n 3"]
) -> Float[Tensor, "b n 3"]:
    """Return points of a slab of floor under the box, reaching a margin beyond its edges.

    ``edges`` are the shares of the lower and the upper half of the box that it leaves free,
    ``uniform`` the places of the points on the covered area, all in 0 to 1.
    """
    margin = _MARGIN * box.radius
    low, high = box.low - margin, box.high + margin
    start, stop = edges[:, :1] / 2, 1 - edges[:, 1:] / 2
    across = low + (high - low) * (start + (stop - start) * uniform)
    depth = box.low - box.radius * (_THICKNESS * uniform)
    return torch.cat([across[..., :2], depth[..., 2:]], dim=2)


def replaced(
    points: Float[Tensor, "b n 3"],
    kept: Bool[Tensor, "b n"],
    substitutes: Float[Tensor, "b n 3"],
    share: Float[Tensor, "b 1"],
    uniform: Float[Tensor, "b n"],
) -> Float[Tensor, "b n 3"]:
    """Replace a share of each cloud's kept points (rounded down), of the highest ``uniform``."""
    count = (share * kept.sum(dim=1, keepdim=True)).long()
    order = uniform.masked_fill(~kept, -1).argsort(dim=1, descending=True, stable=True)
    new = torch.arange(kept.shape[1], device=kept.device) < count
    places = order[..., None].expand_as(points)
    return points.scatter(
        1, places, torch.where(new[..., None], substitutes, points.gather(1, places))
    )


def augment_clouds(
    points: Float[Tensor, "b n 3"], settings: Augmentation, generator: torch.Generator
) -> tuple[Float[Tensor, "b n 3"], Bool[Tensor, "b n"]]:
    """Imitate a scan on a batch of clouds; return the points, and which of them it would keep.

    Args:
        points: Clouds, on any device, in any unit, z up, before they are turned and normalised.
        settings: Kinds, probabilities and strengths. Kinds that are off draw nothing.
        generator: Source of all draws, on the device of the points.
    """
    b, n, _ = points.shape
    kept = torch.ones_like(points[..., 0], dtype=torch.bool)
    if settings == Augmentation():
        return points, kept
    like = {"generator": generator, "device": points.device, "dtype": points.dtype}

    def uniform(*shape: int, low: float = 0.0, high: float = 1.0) -> Tensor:
        return low + (high - low) * torch.rand((b, *shape), **like)

    def strength(probability: float, most: float) -> Float[Tensor, "b 1"]:
        """Strengths up to the greatest; 0 for the clouds that are spared."""
        return most * uniform(1) * (uniform(1) < probability)

    box = robust_box(points)
    if settings.stretch > 0:
        span = math.log(settings.stretch_factor) * (uniform(1, 1) < settings.stretch)
        factor, centre = (span * uniform(1, 3, low=-1.0)).exp(), box.centre
        points = stretched(points, centre, factor)
        box = Box(*(stretched(corner, centre, factor) for corner in box))
    if settings.sight > 0:
        seen = in_sight(points, uniform(1, high=2 * math.pi), uniform(1, high=_HIGHEST))
        enough = seen.float().mean(dim=1, keepdim=True) >= settings.least
        kept = seen | ~((uniform(1) < settings.sight) & enough)
    if settings.plane > 0:
        score = (points * torch.randn((b, 1, 3), **like)).sum(dim=2)
        count = (strength(settings.plane, settings.plane_share) * n).long()
        kept = lose_highest(kept, score, count, settings.least)
    if settings.patches > 0:
        seeds = (uniform(settings.patch_count) * n).long()
        score = near_patch(points, gather_points(points, seeds))
        size = strength(settings.patches, settings.patch_radius) * box.radius[:, 0]
        count = (kept & (-score < size)).sum(dim=1, keepdim=True)
        kept = lose_highest(kept, score, count, settings.least)
    if settings.floor > 0:
        floor = floor_beneath(box, uniform(2, 3), uniform(n, 3))
        share = strength(settings.floor, settings.floor_share)
        points = replaced(points, kept, floor, share, uniform(n))
    if settings.tilt > 0:
        angle = strength(settings.tilt, settings.tilt_degrees).deg2rad()
        points = tilted(points, box.centre, uniform(1, high=2 * math.pi), angle)
    if settings.noise > 0:
        sigma = strength(settings.noise, settings.noise_sigma)[..., None] * box.radius
        points = points + sigma * torch.randn(points.shape, **like)
    return points, kept


def augment(
    points: Float[Tensor, "b n 3"], settings: TrainSettings, generator: torch.Generator
) -> Float[Tensor, "b n 3"]:
    """Rotate clouds about z and jitter them; the generator is on their device.

    Convention:
        Anticlockwise seen from above, as `qs3.geometry.rotation_z`.
    """
    drawn = {"generator": generator, "device": points.device, "dtype": points.dtype}
    if settings.rotate_z:
        points = turned(points, 2 * torch.pi * torch.rand(len(points), 1, **drawn))
    if settings.jitter_sigma > 0 and settings.jitter_clip > 0:
        noise = settings.jitter_sigma * torch.randn(points.shape, **drawn)
        noise = noise.clamp_(-settings.jitter_clip, settings.jitter_clip)
        if settings.preparation.size_input:  # the cloud is in metres
            share = settings.preparation.radius_share
            noise = noise * ball_radius(points, share)[:, None, None]
        points = points + noise
    return points
