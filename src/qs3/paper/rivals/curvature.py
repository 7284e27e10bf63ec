"""Curvature of clouds from the covariance of each point's neighbours."""

import torch
from jaxtyping import Float
from torch import Tensor

from qs3.errors import InputError
from qs3.models.ops import gather_points, knn
from qs3.models.ops.gathering import blocks

_BLOCK = 2**22
"""Neighbour coordinates held at a time."""


@torch.no_grad()
def curvature(points: Float[Tensor, "b n 3"], neighbours: int = 32) -> Float[Tensor, "b n"]:
    """Estimate curvature by principal component analysis of nearest neighbours.

    It is the share of the smallest eigenvalue of their covariance, λ₀ / (λ₀ + λ₁ + λ₂), "surface
    variation" (Pauly et al., VIS 2002): 0 on a plane or a line and if they coincide, 1/3 at most.

    Args:
        points: Clouds, in any unit.
        neighbours: Points of a neighbourhood, with its centre; at most all of a cloud.

    Example:
        >>> plane = torch.cartesian_prod(torch.arange(4.0), torch.arange(4.0), torch.zeros(1))
        >>> float(curvature(plane[None], 8).max())
        0.0
    """
    if neighbours < 3:
        raise InputError(f"neighbours must be at least 3, not {neighbours}; a plane needs three")
    b, n, _ = points.shape
    k = min(neighbours, n)
    with torch.autocast(points.device.type, enabled=False):
        # Double precision: the smallest eigenvalue of a flat patch is a small difference.
        exact = points.double()
        near = knn(points, k)
        parts = []
        for cloud, row in blocks(b, n, 3 * k, _BLOCK):
            around = gather_points(exact[cloud], near[cloud, row])
            around = around - around.mean(dim=2, keepdim=True)
            parts.append((around.transpose(2, 3) @ around / k).flatten(0, 1))
        share = smallest_share(torch.cat(parts))
    return share.view(b, n).to(torch.promote_types(points.dtype, torch.float32))


def smallest_share(matrices: Float[Tensor, "r 3 3"]) -> Float[Tensor, "r"]:
    """Return the share of the trace that the smallest eigenvalue has; what rounding leaves is 0.

    Example:
        >>> share = smallest_share(torch.diag(torch.tensor([2.0, 1.0, 1.0]))[None] * 0.25)
        >>> round(float(share), 6)
        0.25
    """
    values = torch.linalg.eigvalsh(matrices)
    total = values.sum(dim=1)
    share = values[:, 0] / total.where(total > 0, 1.0)
    return share.where(share > 64 * torch.finfo(share.dtype).eps, 0.0)
