"""Batch normalisation without its input: moments of what came before go into the weights.

Batch normalisation of W x needs the mean and the variance of W x alone. Both follow from the mean m
and the covariance Σ of x: W m and, for row w of W, wᵀ Σ w. Where x has fewer channels than W x, or
takes few values, this is cheaper than to form W x, read it twice and write it again.
"""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn


class Moments(NamedTuple):
    """Mean and covariance of the rows that a batch normalisation counts."""

    mean: Float[Tensor, "c"]
    """Mean of the rows."""
    covariance: Float[Tensor, "c c"]
    """Biased covariance of the rows."""
    rows: int
    """Number of rows."""


def row_moments(rows: Float[Tensor, "r c"]) -> Moments:
    """Return the moments of rows, taken about their mean.

    Example:
        >>> row_moments(torch.tensor([[1.0], [3.0]])).covariance
        tensor([[1.]])
    """
    mean = rows.mean(dim=0)
    centred = rows - mean
    return Moments(mean, centred.t() @ centred / len(rows), len(rows))


def fold_norm(
    norm: nn.BatchNorm1d,
    weight: Float[Tensor, "d c"],
    moments: Moments | None,
    constant: Float[Tensor, "d"] | None = None,
) -> tuple[Float[Tensor, "d c"], Float[Tensor, "d"]]:
    """Return weight and bias of a linear map that is this one, then its batch normalisation.

    In training the running statistics move as those of `norm` would.

    Args:
        norm: Scale, shift and running statistics.
        weight: The linear map.
        moments: Those of its input; needed where ``norm`` is in training.
        constant: Added to the linear map's output before the normalisation, which takes it away
            again in training.
    """
    assert norm.running_mean is not None and norm.running_var is not None  # noqa: S101
    if not norm.training:
        scale = norm.weight * torch.rsqrt(norm.running_var + norm.eps)
        known = norm.running_mean if constant is None else norm.running_mean - constant
        return scale[:, None] * weight, norm.bias - scale * known
    assert moments is not None  # noqa: S101
    mean = weight @ moments.mean
    variance = ((weight @ moments.covariance) * weight).sum(dim=1).clamp_min(0.0)
    update_running(norm, mean if constant is None else mean + constant, variance, moments.rows)
    scale = norm.weight * torch.rsqrt(variance + norm.eps)
    return scale[:, None] * weight, norm.bias - scale * mean


@torch.no_grad()
def update_running(
    norm: nn.BatchNorm1d, mean: Float[Tensor, "c"], variance: Float[Tensor, "c"], count: int
) -> None:
    """Move the running statistics as batch normalisation does.

    Args:
        norm: The layer.
        mean: Mean of its input.
        variance: Biased variance of its input.
        count: Number of values that both are taken over.
    """
    assert norm.running_mean is not None and norm.running_var is not None  # noqa: S101
    assert norm.num_batches_tracked is not None and norm.momentum is not None  # noqa: S101
    norm.num_batches_tracked.add_(1)
    norm.running_mean.lerp_(mean.to(norm.running_mean), norm.momentum)
    unbiased = variance * (count / max(count - 1, 1))
    norm.running_var.lerp_(unbiased.to(norm.running_var), norm.momentum)
