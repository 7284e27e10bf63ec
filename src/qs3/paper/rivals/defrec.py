"""Deformation reconstruction, DefRec (Achituve et al., WACV 2021)."""

from dataclasses import dataclass
from typing import cast

import torch
from jaxtyping import Bool, Float, Int
from torch import Generator, Tensor, nn

from qs3.adaptation.method import Batch, Method, Target, Terms
from qs3.checks import Share
from qs3.models import Features, feature_widths
from qs3.models.ops import gather_points
from qs3.paper.rivals.deformations import deform_voxels

_SCALE = 20.0
"""Factor of the released code, which brings the distance to the size of a cross entropy."""


def chamfer(
    x: Float[Tensor, "b n 3"],
    y: Float[Tensor, "b m 3"],
    x_mask: Bool[Tensor, "b n"] | None = None,
    y_mask: Bool[Tensor, "b m"] | None = None,
) -> Float[Tensor, "b"]:
    """Symmetric squared Chamfer distance of each pair of clouds, over masked points only.

    mean_i min_j |x_i − y_j|² + mean_j min_i |x_i − y_j|² (Fan et al., CVPR 2017, with means in
    place of sums). Nearest neighbours are found without a gradient, which passes through the n + m
    pairs alone. Where there is no mask all points count.

    Returns:
        One distance a pair; 0 if one of the two has no point that counts.

    Example:
        >>> x, y = torch.zeros(1, 2, 3), torch.ones(1, 1, 3)
        >>> chamfer(x, y)
        tensor([6.])
    """
    with torch.autocast(x.device.type, enabled=False):
        dtype = torch.promote_types(torch.promote_types(x.dtype, y.dtype), torch.float32)
        x, x_valid = _compact(x.to(dtype), x_mask)
        y, y_valid = _compact(y.to(dtype), y_mask)
        if 0 in (x.shape[1], y.shape[1]):
            return (x.sum(dim=(1, 2)) + y.sum(dim=(1, 2))) * 0.0
        of_x, of_y = _nearest(x, y, y_valid), _nearest(y, x, x_valid)
        both = x_valid.any(dim=1) & y_valid.any(dim=1)
        forth = _mean_square(x, gather_points(y, of_x), x_valid & both[:, None])
        back = _mean_square(y, gather_points(x, of_y), y_valid & both[:, None])
    return forth + back


def _compact(points: Tensor, mask: Tensor | None) -> tuple[Tensor, Tensor]:
    if mask is None:
        return points, torch.ones(points.shape[:2], dtype=torch.bool, device=points.device)
    most = int(mask.sum(dim=1).amax()) if mask.numel() else 0
    order = (~mask).to(torch.uint8).argsort(dim=1, stable=True)[:, :most]
    return gather_points(points, order), mask.gather(1, order)


def _mean_square(points: Tensor, partners: Tensor, valid: Tensor) -> Tensor:
    # Excluded pairs are replaced, not multiplied by 0, so that none of their gradient is left.
    square = (points - partners).square().sum(dim=2)
    return square.where(valid, 0.0).sum(dim=1) / valid.sum(dim=1).clamp_min(1)


@torch.no_grad()
def _nearest(
    queries: Float[Tensor, "b n 3"], points: Float[Tensor, "b m 3"], valid: Bool[Tensor, "b m"]
) -> Int[Tensor, "b n"]:
    """Return the valid point nearest to each query, each cloud from its own.

    Distances come from differences, which a far origin or a wild prediction does not harm.
    """
    distance = torch.cdist(queries, points, compute_mode="donot_use_mm_for_euclid_dist")
    return distance.masked_fill_(~valid[:, None], torch.inf).argmin(dim=2)


def reconstruction_loss(
    predicted: Float[Tensor, "b n 3"],
    original: Float[Tensor, "b n 3"],
    moved: Bool[Tensor, "b n"],
) -> Float[Tensor, ""]:
    """20 times the Chamfer distance over the moved points, mean over the clouds.

    Example:
        >>> cloud, moved = torch.zeros(1, 4, 3), torch.tensor([[True, False, False, True]])
        >>> float(reconstruction_loss(cloud + 0.5, cloud, moved))
        30.0
    """
    return _SCALE * chamfer(predicted, original, moved, moved).mean()


class ReconstructionHead(nn.Module):
    """Layers of 256, 256 and 128 channels and three coordinates, at each moved point.

    Their input is the point's local feature and its cloud's pooled one. The pooled part of the
    first product is made once a cloud, so that the two are never joined. Batch normalisation
    counts the moved points of the whole batch.

    Args:
        local: Channels of the local features.
        pooled: Channels of the pooled feature.
        dropout: Probability of dropping a hidden unit.
    """

    def __init__(self, local: int, pooled: int, dropout: float) -> None:
        super().__init__()
        self.local = nn.Linear(local, 256, bias=False)
        self.pooled = nn.Linear(pooled, 256, bias=False)
        layers: list[nn.Module] = [*_finish(256, dropout)]
        for width, following in ((256, 256), (256, 128)):
            layers += [nn.Linear(width, following, bias=False), *_finish(following, dropout)]
        # The released network drops nothing right before the coordinates.
        self.layers = nn.Sequential(*layers[:-1], nn.Linear(128, 3))

    def forward(self, features: Features, moved: Bool[Tensor, "b n"]) -> Float[Tensor, "b n 3"]:
        """Return where moved points were; 0 for all others."""
        local = features.local
        assert local is not None  # noqa: S101
        b, n, e = local.shape
        row = moved.flatten().nonzero()[:, 0]
        of_points = gather_points(local.reshape(1, b * n, e), row[None])
        of_clouds = gather_points(self.pooled(features.pooled)[None], row[None] // n)
        places = self.layers((self.local(of_points) + of_clouds)[0])
        nowhere = torch.zeros((b * n, 3), dtype=places.dtype, device=places.device)
        return nowhere.index_put((row,), places).view(b, n, 3)


def _finish(width: int, dropout: float) -> tuple[nn.Module, ...]:
    return nn.BatchNorm1d(width), nn.ReLU(inplace=True), nn.Dropout(dropout)


@dataclass(eq=False, repr=False, kw_only=True)
class DefRec(Method):
    """Classify the source; rebuild deformed parts of target clouds, and of source clouds if wanted.

    L = (1 − w) · CE(source) + w · 20 · Chamfer(rebuilt part, original part).

    NOTE: the deformation is that of the authors' scripts, one of 27 cells. There the cell is the
    first in a random order *of the batch* with 40 points, and a cloud without one has no finite
    loss; here each cloud has its own order and falls back to its fullest cell.
    NOTE: the head is evaluated at the moved points alone; the released one at all points, masked.
    NOTE: the weight and ``on_source`` are those of the released scripts; the defaults of their
    parser are 0.5 and true.
    """

    uses_target = True
    needs_local = True
    in_unit_ball = True

    weight: Share = 0.2
    """w, weight of the reconstruction."""
    on_source: bool = False
    """Deform and rebuild source clouds too; a third pass."""
    dropout: Share = 0.5
    """Dropout of the reconstruction head."""

    def __post_init__(self) -> None:
        super().__post_init__()
        widths = feature_widths(self.model)
        head = ReconstructionHead(cast(int, widths.local), widths.pooled, self.dropout)
        self.rebuild = nn.ModuleDict({"head": head})  # checkpoints know it as rebuild.head

    def losses(self, source: Batch, target: Target, progress: float, generator: Generator) -> Terms:
        """Return the cross entropy of the source and the distance of rebuilt parts."""
        cross_entropy = self.classification(self.model(source.points), source)
        rebuilt = self.rebuilding(source.points, target, generator)
        return {"source": (1 - self.weight) * cross_entropy, **rebuilt}

    def rebuilding(
        self, source: Float[Tensor, "b n 3"], target: Target, generator: Generator
    ) -> Terms:
        """Deform clouds, rebuild what moved, and return the weighted loss of each domain."""
        assert target is not None  # noqa: S101
        domains = [("source", source), ("target", target)]
        terms = {}
        for domain, points in domains if self.on_source else domains[1:]:
            deformed = deform_voxels(points, generator)
            predicted = self.rebuild["head"](self.model.encode(deformed.points), deformed.moved)
            loss = reconstruction_loss(predicted, points, deformed.moved)
            terms[f"defrec_{domain}"] = self.weight * loss
        return terms
