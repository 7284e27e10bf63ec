"""MMD: one distribution of pooled features in both domains (DAN: Long et al., ICML 2015)."""

import torch
from jaxtyping import Float
from torch import Tensor

from qs3.adaptation.discrepancies import mmd, squared_distances
from qs3.adaptation.method import Batch, Method
from qs3.adaptation.normalisation import DomainNorm
from qs3.errors import InputError
from qs3.models import PointClassifier
from qs3.models.checks import check_flag, check_number

FACTORS = tuple(2.0 ** (step / 2) for step in range(-16, 17))
"""DAN's kernels: 2⁻⁸ to 2⁸ times the median squared distance, in steps of √2 (§4.1)."""

_LEAST = 1e-12
"""Smallest squared distance; all features are equal below it."""


def median_bandwidths(
    x: Float[Tensor, "b c"], y: Float[Tensor, "m c"], factors: tuple[float, ...] = FACTORS
) -> Float[Tensor, "s"]:
    """Return σ of kernels with 2σ² = factor × median squared distance of all pairs of rows.

    No gradient passes through them.

    Args:
        x: One sample.
        y: The other.
        factors: One a kernel.

    Example:
        >>> median_bandwidths(torch.tensor([[0.0]]), torch.tensor([[2.0]]), (2.0,)).tolist()
        [2.0]
    """
    with torch.no_grad():
        squared = squared_distances(x.detach(), y.detach())
        row, column = torch.triu_indices(*squared.shape, offset=1, device=x.device)
        median = squared[row, column].median().clamp_min(_LEAST)
        return (median * torch.tensor(factors, dtype=median.dtype, device=x.device) / 2).sqrt()


class MMD(Method):
    """Cross entropy on the source plus the discrepancy of the pooled features' distributions.

    NOTE: DAN matches three layers of AlexNet, learns the kernels' mixture and estimates the
    unbiased discrepancy in linear time. Here it is the one layer that the head decides on, the
    kernels weigh alike, and the estimate takes all pairs, biased by default.

    Args:
        model: The network to train.
        mmd_weight: Factor of the discrepancy, λ of DAN (eq. 4).
        factors: Kernels, as multiples of the median squared distance of the batches; see
            `median_bandwidths`.
        biased: See `qs3.adaptation.discrepancies.mmd`.
        label_smoothing: ε on the source.
        norm: How the network normalises the two domains.

    Raises:
        InputError: where a setting is unusable.
    """

    uses_target = True

    def __init__(
        self,
        model: PointClassifier,
        *,
        mmd_weight: float = 1.0,
        factors: tuple[float, ...] = FACTORS,
        biased: bool = True,
        label_smoothing: float = 0.0,
        norm: DomainNorm | None = None,
    ) -> None:
        super().__init__(model, label_smoothing=label_smoothing, norm=norm)
        check_number("mmd_weight", mmd_weight, 0.0, 1e6)
        check_flag("biased", biased)
        if not factors:
            raise InputError("factors must be one number or more")
        for factor in factors:
            check_number("each of factors", factor)
        self.mmd_weight, self.factors, self.biased = mmd_weight, tuple(factors), biased

    def losses(
        self,
        source: Batch,
        target: Float[Tensor, "b_t n_t 3"] | None,
        progress: float,
        generator: torch.Generator,
    ) -> dict[str, Tensor]:
        """Return the cross entropy of the source and the discrepancy, mean over the kernels."""
        assert target is not None  # noqa: S101
        here = self.features(source.points, "source")
        there = self.features(target, "target")
        bandwidths = median_bandwidths(here.pooled, there.pooled, self.factors)
        distance = mmd(here.pooled, there.pooled, bandwidths, self.biased) / len(self.factors)
        return {
            "source": self.classification(self.head(here, "source"), source),
            "mmd": self.mmd_weight * distance,
        }
