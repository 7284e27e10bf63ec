"""MMD: one distribution of pooled features in both domains (DAN: Long et al., ICML 2015)."""

from collections.abc import Sequence
from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Generator, Tensor

from qs3.adaptation.method import Batch, Method, Target, Terms
from qs3.errors import InputError
from qs3.models.checks import check_positive, check_range

FACTORS = tuple(2.0 ** (step / 2) for step in range(-16, 17))
"""DAN's kernels: 2⁻⁸ to 2⁸ times the median squared distance, in steps of √2 (§4.1)."""

_LEAST = 1e-12
"""Smallest squared distance; all features are equal below it."""


def mmd(
    x: Float[Tensor, "b c"],
    y: Float[Tensor, "m c"],
    bandwidths: Sequence[float] | Float[Tensor, "s"],
    biased: bool = True,
) -> Float[Tensor, ""]:
    """Squared maximum mean discrepancy with a sum of Gaussian kernels.

    k(u, v) = Σ_σ exp(−|u − v|² / 2σ²), and MMD² = mean k(x, x') + mean k(y, y') − 2 mean k(x, y)
    (Gretton et al., JMLR 2012: eq. 5 biased, eq. 3 unbiased).

    ``bandwidths`` are σ of each kernel, in the unit of the features.
    In the biased estimate a row's pair with itself counts, and the value is never negative; the
    expectation of the other is 0 for samples of one distribution.

    Raises:
        InputError: where a sample is empty, or has a single row and the estimate is unbiased.

    Example:
        >>> one, other = torch.zeros(2, 1), torch.full((2, 1), 2.0)
        >>> round(float(mmd(one, other, [1.0])), 4)  # 2 − 2 exp(−2)
        1.7293
    """
    least = 1 if biased else 2
    if min(len(x), len(y)) < least:
        raise InputError(f"mmd needs samples of {least} or more, not {len(x)} and {len(y)}")
    squared = squared_distances(x, y)
    kernel = torch.zeros_like(squared)
    for sigma in bandwidths:
        kernel = kernel + torch.exp(squared / (-2 * sigma**2))
    b = len(x)
    within = 0.0
    for square in (kernel[:b, :b], kernel[b:, b:]):
        count = len(square)
        if biased:
            within = within + square.mean()
        else:
            within = within + (square.sum() - square.diagonal().sum()) / (count * (count - 1))
    dtype = torch.promote_types(x.dtype, torch.float32)
    return (within - 2 * kernel[:b, b:].mean()).to(dtype)


def squared_distances(x: Float[Tensor, "b c"], y: Float[Tensor, "m c"]) -> Float[Tensor, "b+m b+m"]:
    """Return |u − v|² for all pairs of the rows of x, then y; in double precision.

    |u|² + |v|² − 2u·v loses half of the digits; in double precision more than single ones remain,
    and no [b m c] tensor is made.

    Example:
        >>> squared_distances(torch.tensor([[0.0, 0.0]]), torch.tensor([[3.0, 4.0]])).tolist()
        [[0.0, 25.0], [25.0, 0.0]]
    """
    with torch.autocast(x.device.type, enabled=False):
        rows = torch.cat([x.double(), y.double()])
        rows = rows - rows.mean(dim=0).detach()
        length = rows.square().sum(dim=1)
        total = length[:, None] + length - 2 * rows @ rows.t()
        # Rounding can leave a hair below zero, and off zero for a row and itself.
        return total.clamp_min(0.0).fill_diagonal_(0.0)


def median_bandwidths(
    x: Float[Tensor, "b c"], y: Float[Tensor, "m c"], factors: tuple[float, ...] = FACTORS
) -> Float[Tensor, "s"]:
    """Return σ of kernels with 2σ² = factor × median squared distance of all pairs of rows.

    No gradient passes through them.

    Example:
        >>> median_bandwidths(torch.tensor([[0.0]]), torch.tensor([[2.0]]), (2.0,)).tolist()
        [2.0]
    """
    with torch.no_grad():
        squared = squared_distances(x.detach(), y.detach())
        row, column = torch.triu_indices(*squared.shape, offset=1, device=x.device)
        median = squared[row, column].median().clamp_min(_LEAST)
        return (median * torch.tensor(factors, dtype=median.dtype, device=x.device) / 2).sqrt()


@dataclass(eq=False, repr=False, kw_only=True)
class MMD(Method):
    """Cross entropy on the source plus the discrepancy of the pooled features' distributions.

    NOTE: DAN matches three layers of AlexNet, learns the kernels' mixture and estimates the
    unbiased discrepancy in linear time. Here it is the one layer that the head decides on, the
    kernels weigh alike, and the estimate takes all pairs, biased by default.
    """

    uses_target = True

    mmd_weight: float = 1.0
    """Factor of the discrepancy, λ of DAN (eq. 4)."""
    factors: tuple[float, ...] = FACTORS
    """Kernels, as multiples of the batches' median squared distance; see `median_bandwidths`."""
    biased: bool = True
    """See `mmd`."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_range("mmd_weight", self.mmd_weight, 0, 1e6)
        check_positive("factors", self.factors)

    def losses(self, source: Batch, target: Target, progress: float, generator: Generator) -> Terms:
        """Return the cross entropy of the source and the discrepancy, mean over the kernels."""
        of_source, of_target = self.both(source, target)
        bandwidths = median_bandwidths(of_source.pooled, of_target.pooled, self.factors)
        distance = mmd(of_source.pooled, of_target.pooled, bandwidths, self.biased)
        return {
            "source": self.classification(self.head(of_source, "source"), source),
            "mmd": self.mmd_weight * (distance / len(self.factors)),
        }
