"""Random changes of a cloud's shape that keep its class and its number of points.

Convention:
    Clouds are [b n 3] in the unit ball. Every draw comes from the given generator on the CPU and is
    made in single precision, so that it does not depend on the device. Each cloud draws its own.
    Angles are in radians.
"""

import math

import torch
from jaxtyping import Float
from torch import Tensor

from qs3.errors import InputError
from qs3.models.checks import check_range

_REACH = 1.0
"""Half the side of the cube over which `elastic` draws its displacements."""


def jitter(
    points: Float[Tensor, "b n 3"],
    generator: torch.Generator,
    sigma: float = 0.01,
    clip: float = 0.05,
) -> Float[Tensor, "b n 3"]:
    """Move every point by Gaussian noise of this deviation, cut at ``clip`` in each axis.

    Example:
        >>> moved = jitter(torch.zeros(1, 4, 3), torch.Generator().manual_seed(0))
        >>> bool((moved != 0).all() and (moved.abs() <= 0.05).all())
        True
    """
    noise = sigma * torch.randn(points.shape, generator=generator)
    return points + noise.clamp_(-clip, clip).to(points)


def rescale(
    points: Float[Tensor, "b n 3"],
    generator: torch.Generator,
    low: float = 0.7,
    high: float = 1.5,
) -> Float[Tensor, "b n 3"]:
    """Multiply each cloud by a factor drawn evenly between two bounds.

    Example:
        >>> factor = rescale(torch.ones(1, 1, 3), torch.Generator().manual_seed(0))
        >>> bool((factor == factor[0, 0, 0]).all() and 0.7 <= factor[0, 0, 0] <= 1.5)
        True
    """
    factor = low + (high - low) * torch.rand(len(points), 1, 1, generator=generator)
    return points * factor.to(points)


def tilt(
    points: Float[Tensor, "b n 3"],
    generator: torch.Generator,
    sigma: float = 0.06,
    clip: float = 0.18,
) -> Float[Tensor, "b n 3"]:
    """Turn each cloud about x, then y, then z, by angles of this deviation, cut at ``clip``.

    Example:
        >>> tilt(torch.zeros(2, 5, 3), torch.Generator()).shape
        torch.Size([2, 5, 3])
    """
    angles = (sigma * torch.randn(len(points), 3, generator=generator)).clamp_(-clip, clip)
    for axis in range(3):
        c, s = angles[:, axis, None].cos().to(points), angles[:, axis, None].sin().to(points)
        first, second = (axis + 1) % 3, (axis + 2) % 3
        turned = list(points.unbind(2))
        a, b = turned[first], turned[second]
        turned[first], turned[second] = c * a - s * b, s * a + c * b
        points = torch.stack(turned, dim=2)
    return points


def occlude(
    points: Float[Tensor, "b n 3"], generator: torch.Generator, keep: float = 0.7
) -> Float[Tensor, "b n 3"]:
    """Cut each cloud with a random plane and put points of the kept side in place of the others.

    The ⌈keep · n⌉ points farthest along a direction drawn evenly from the sphere stay where they
    are in the order; every other one becomes one of them, drawn evenly.

    Raises:
        InputError: where ``keep`` is not above 0 and at most 1.

    Example:
        >>> line = torch.tensor([[[-1.0, 0, 0], [1, 0, 0]]])
        >>> seen = occlude(line, torch.Generator().manual_seed(0), keep=0.5)
        >>> bool((seen[0, 0] == seen[0, 1]).all())
        True
    """
    if not 0.0 < keep <= 1.0:
        raise InputError(f"keep must be above 0 and at most 1, not {keep}")
    b, n, _ = points.shape
    kept = min(n, math.ceil(keep * n))
    direction = torch.randn(b, 3, 1, generator=generator)
    draws = torch.rand(b, n - kept, generator=generator).to(points.device)
    depth = (points - points.mean(dim=1, keepdim=True)).to(direction.dtype) @ direction.to(
        points.device
    )
    order = depth[:, :, 0].sort(dim=1, descending=True, stable=True).indices
    filled = order.gather(1, (draws * kept).long().clamp_(max=kept - 1))
    index = torch.arange(n, device=points.device).repeat(b, 1).scatter(1, order[:, kept:], filled)
    return points.gather(1, index[:, :, None].expand(-1, -1, 3))


def elastic(
    points: Float[Tensor, "b n 3"],
    generator: torch.Generator,
    grain: float = 0.2,
    strength: float = 0.4,
) -> Float[Tensor, "b n 3"]:
    """Bend each cloud by a smooth random field of displacements (Simard et al., 2003, in 3D).

    Standard normal vectors are drawn on a cubic grid whose nodes are ``grain`` apart, averaged
    twice over 3³ nodes, multiplied by the strength (their deviation is then about 0.11 of it) and
    interpolated linearly at the points. The grid covers the unit ball; points beyond move as its
    border does.

    Raises:
        InputError: where the grain is below 0.05, which would need too large a grid.

    Example:
        >>> elastic(torch.zeros(2, 5, 3), torch.Generator(), 0.8, 0.0).abs().max()
        tensor(0.)
    """
    check_range("grain", grain, 0.05)
    nodes = 2 * math.ceil(_REACH / grain) + 3
    noise = torch.randn(len(points), 3, nodes, nodes, nodes, generator=generator)
    for _ in range(2):
        noise = torch.nn.functional.avg_pool3d(noise, 3, stride=1, padding=1)
    # The last axis of the field is that of the first coordinate.
    place = points.float() * (2 / ((nodes - 1) * grain))
    moved = torch.nn.functional.grid_sample(
        noise.to(points.device), place[:, None, None], padding_mode="border", align_corners=True
    )
    return points + strength * moved[:, :, 0, 0].transpose(1, 2).to(points.dtype)
