"""How far two samples of features, or two classifiers, are from each other.

Convention:
    Samples are [b c], one row a cloud; the two may have different numbers of rows. All are computed
    in single precision at least, whatever the precision around them.
"""

from collections.abc import Sequence

import torch
from jaxtyping import Float
from torch import Tensor

from qs3.errors import InputError


def mmd(
    x: Float[Tensor, "b c"],
    y: Float[Tensor, "m c"],
    bandwidths: Sequence[float] | Float[Tensor, "s"],
    biased: bool = True,
) -> Float[Tensor, ""]:
    """Squared maximum mean discrepancy with a sum of Gaussian kernels.

    k(u, v) = Σ_σ exp(−|u − v|² / 2σ²), and MMD² = mean k(x, x') + mean k(y, y') − 2 mean k(x, y)
    (Gretton et al., JMLR 2012: eq. 5 biased, eq. 3 unbiased).

    Args:
        x: One sample.
        y: The other.
        bandwidths: σ of each kernel, in the unit of the features.
        biased: Whether a row's pair with itself counts; then the value is never negative. Without,
            its expectation is 0 for samples of one distribution.

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
    kernel = _gaussians(squared_distances(x, y), bandwidths)
    b = len(x)
    within = 0.0
    for square in (kernel[:b, :b], kernel[b:, b:]):
        count = len(square)
        if biased:
            within = within + square.mean()
        else:
            within = within + (square.sum() - square.diagonal().sum()) / (count * (count - 1))
    return (within - 2 * kernel[:b, b:].mean()).to(_single(x))


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


def _gaussians(
    squared: Float[Tensor, "n n"], bandwidths: Sequence[float] | Float[Tensor, "s"]
) -> Float[Tensor, "n n"]:
    """Return Σ_σ exp(−d²/2σ²)."""
    total = torch.zeros_like(squared)
    for sigma in bandwidths:
        total = total + torch.exp(squared / (-2 * sigma**2))
    return total


def coral(x: Float[Tensor, "b c"], y: Float[Tensor, "m c"]) -> Float[Tensor, ""]:
    """Distance of the covariances: |C_x − C_y|²_F / 4c² (Sun & Saenko, ECCV 2016 W, eq. 1).

    C is the unbiased covariance over the rows (eqs. 2 and 3).

    Args:
        x: One sample.
        y: The other.

    Raises:
        InputError: where a sample has fewer than two rows.

    Example:
        >>> float(coral(torch.tensor([[-1.0], [1.0]]), torch.zeros(2, 1)))  # variances 2 and 0
        1.0
    """
    if min(len(x), len(y)) < 2:
        raise InputError(f"coral needs samples of 2 or more, not {len(x)} and {len(y)}")
    with torch.autocast(x.device.type, enabled=False):
        difference = _covariance(x.to(_single(x))) - _covariance(y.to(_single(y)))
        return difference.square().sum() / (4 * x.shape[1] ** 2)


def _covariance(x: Float[Tensor, "b c"]) -> Float[Tensor, "c c"]:
    centred = x - x.mean(dim=0)
    return centred.t() @ centred / (len(x) - 1)


def classifier_discrepancy(p1: Float[Tensor, "b k"], p2: Float[Tensor, "b k"]) -> Float[Tensor, ""]:
    """Mean |p₁ − p₂| over clouds and classes (Saito et al., CVPR 2018, eq. 2).

    Args:
        p1: Class probabilities of one classifier.
        p2: Those of the other, of the same clouds.

    Example:
        >>> float(classifier_discrepancy(torch.tensor([[1.0, 0.0]]), torch.tensor([[0.5, 0.5]])))
        0.5
    """
    dtype = _single(p1)
    return (p1.to(dtype) - p2.to(dtype)).abs().mean()


def _single(x: Tensor) -> torch.dtype:
    """Return the type of ``x``, single precision at least."""
    return torch.promote_types(x.dtype, torch.float32)
