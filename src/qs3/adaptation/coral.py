"""CORAL: both domains with one covariance (Deep CORAL: Sun & Saenko, ECCV 2016 workshops)."""

from dataclasses import dataclass
from typing import Literal

import torch
from jaxtyping import Float
from torch import Generator, Tensor

from qs3.adaptation.method import Batch, Method, Target, Terms
from qs3.errors import InputError
from qs3.models.checks import check_range

Layer = Literal["logits", "pooled"]
"""What has its covariance matched: the scores, as published, or the head's input."""


def coral(x: Float[Tensor, "b c"], y: Float[Tensor, "m c"]) -> Float[Tensor, ""]:
    """Distance of the covariances: |C_x − C_y|²_F / 4c² (Sun & Saenko, ECCV 2016 W, eq. 1).

    C is the unbiased covariance over the rows (eqs. 2 and 3); in single precision at least.

    Raises:
        InputError: where a sample has fewer than two rows.

    Example:
        >>> float(coral(torch.tensor([[-1.0], [1.0]]), torch.zeros(2, 1)))  # variances 2 and 0
        1.0
    """
    if min(len(x), len(y)) < 2:
        raise InputError(f"coral needs samples of 2 or more, not {len(x)} and {len(y)}")
    dtype = torch.promote_types(x.dtype, torch.float32)
    with torch.autocast(x.device.type, enabled=False):
        difference = _covariance(x.to(dtype)) - _covariance(y.to(dtype))
        return difference.square().sum() / (4 * x.shape[1] ** 2)


def _covariance(x: Float[Tensor, "b c"]) -> Float[Tensor, "c c"]:
    centred = x - x.mean(dim=0)
    return centred.t() @ centred / (len(x) - 1)


@dataclass(eq=False, repr=False, kw_only=True)
class CORAL(Method):
    """Cross entropy on the source plus the distance of the domains' covariances.

    NOTE: the paper sets the weight so that both losses end about equal, and gives no number; here
    it is 1. Its last layer learns ten times as fast as the others, which came pretrained; here
    all are new and learn alike.
    """

    uses_target = True

    coral_weight: float = 1.0
    """Factor of the distance, λ of the paper (eq. 6)."""
    layer: Layer = "logits"
    """Whose covariance is matched."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_range("coral_weight", self.coral_weight, 0, 1e6)

    def losses(self, source: Batch, target: Target, progress: float, generator: Generator) -> Terms:
        """Return the cross entropy of the source and the distance of the covariances."""
        of_source, of_target = self.both(source, target)
        logits = self.head(of_source, "source")
        if self.layer == "logits":
            distance = coral(logits, self.head(of_target, "target"))
        else:
            distance = coral(of_source.pooled, of_target.pooled)
        return {
            "source": self.classification(logits, source),
            "coral": self.coral_weight * distance,
        }
