"""Curvature of clouds from the covariance of each point's neighbours."""

import math

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
    """Return the share of the trace that the smallest eigenvalue has.

    Closed form for symmetric matrices without negative eigenvalues (Smith, CACM 1961): as many
    small problems as there are points are slow for an iterative solver. The eigenvector is the
    longest product of two rows of A − λ₀ I.

    Example:
        >>> share = smallest_share(torch.diag(torch.tensor([2.0, 1.0, 1.0]))[None] * 0.25)
        >>> round(float(share), 6)
        0.25
    """
    scale = matrices.abs().amax(dim=(1, 2))
    unit = matrices / scale.where(scale > 0, 1.0)[:, None, None]
    eye = torch.eye(3, dtype=unit.dtype, device=unit.device)
    mean = unit.diagonal(dim1=1, dim2=2).mean(dim=1)
    shifted = unit - mean[:, None, None] * eye
    spread = (shifted.square().sum(dim=(1, 2)) / 6).sqrt()
    tiny = 64 * torch.finfo(unit.dtype).eps
    round_ = spread <= tiny
    a, b, c = (shifted / spread.where(~round_, 1.0)[:, None, None]).unbind(dim=1)
    cosine = (a * torch.linalg.cross(b, c, dim=1)).sum(dim=1) / 2  # half of the determinant
    angle = cosine.clamp(-1, 1).acos() / 3
    least = mean + 2 * spread * (angle + 2 * math.pi / 3).cos()
    rest = unit - least[:, None, None] * eye
    products = torch.linalg.cross(rest[:, [0, 1, 2]], rest[:, [1, 2, 0]], dim=2)
    normal, length = _longest(products)
    # If the two smallest eigenvalues are equal, anything across the largest one's axis will do.
    line, _ = _longest(rest)
    across = torch.linalg.cross(line, eye[line.abs().argmin(dim=1)], dim=1)
    across = across / across.norm(dim=1, keepdim=True).clamp_min(tiny)
    normal = torch.where((length <= tiny)[:, None], across, normal)
    normal = torch.where(round_[:, None], eye[2], normal)
    # The arc cosine loses half the digits if two eigenvalues are close; nᵀ A n does not.
    least = (normal * (unit @ normal[:, :, None])[:, :, 0]).sum(dim=1)
    share = (least / (3 * mean).where(mean > 0, 1.0)).clamp(0, 1 / 3)
    return share.where(share > tiny, 0.0)


def _longest(rows: Float[Tensor, "r 3 3"]) -> tuple[Float[Tensor, "r 3"], Float[Tensor, "r"]]:
    lengths = rows.norm(dim=2)
    length, which = lengths.max(dim=1)
    longest = rows.gather(1, which[:, None, None].expand(-1, 1, 3))[:, 0]
    return longest / length.where(length > 0, 1.0)[:, None], length
