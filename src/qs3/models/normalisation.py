"""Batch normalisation without its input: moments of what came before go into the weights.

Batch normalisation of W x needs the mean and the variance of W x alone. Both follow from the mean m
and the covariance Σ of x: W m and, for row w of W, wᵀ Σ w. Where x has fewer channels than W x, or
takes few values, this is cheaper than to form W x, read it twice and write it again.
"""

from typing import NamedTuple

import torch
from jaxtyping import Float
from torch import Tensor, nn

from qs3.models.classifier import LinearNorm


class Moments(NamedTuple):
    """Mean and covariance of the rows that a batch normalisation counts."""

    mean: Float[Tensor, "c"]
    covariance: Float[Tensor, "c c"]
    rows: int


def row_moments(rows: Float[Tensor, "r c"]) -> Moments:
    """Return the moments of rows, taken about their mean."""
    mean = rows.mean(dim=0)
    centred = rows - mean
    return Moments(mean, centred.t() @ centred / len(rows), len(rows))


def uses_batch(norm: nn.Module) -> bool:
    """Return whether a batch normalisation takes the statistics of its batch, not running ones.

    The layer's own mode decides, not that of the network around it.
    """
    assert isinstance(norm, nn.modules.batchnorm._BatchNorm)  # noqa: S101
    return norm.training or norm.running_mean is None or norm.running_var is None


def fold_norm(
    norm: nn.BatchNorm1d,
    weight: Float[Tensor, "d c"],
    moments: Moments | None,
    constant: Float[Tensor, "d"] | None = None,
) -> tuple[Float[Tensor, "d c"], Float[Tensor, "d"]]:
    """Return weight and bias of a linear map that is this one, then its batch normalisation.

    In training the running statistics move as those of ``norm`` would, by the moments of the map's
    input. A ``constant`` is added to its output before the normalisation, which takes it away again
    in training.
    """
    if not uses_batch(norm):
        assert norm.running_mean is not None and norm.running_var is not None  # noqa: S101
        scale = norm.weight * torch.rsqrt(norm.running_var + norm.eps)
        before = norm.running_mean if constant is None else norm.running_mean - constant
        return scale[:, None] * weight, norm.bias - scale * before
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
    """Move the running statistics, if there are any, as batch normalisation does.

    Without a momentum they are the plain mean over all batches so far. ``count`` is the number of
    values that the mean and the biased variance are taken over.
    """
    running_mean, running_variance = norm.running_mean, norm.running_var
    # A layer without running statistics keeps none; one in evaluation keeps those it has.
    moves = norm.training and norm.track_running_stats
    if not moves or running_mean is None or running_variance is None:
        return
    assert norm.num_batches_tracked is not None  # noqa: S101
    norm.num_batches_tracked.add_(1)
    momentum = norm.momentum
    if momentum is None:
        momentum = norm.num_batches_tracked.to(running_mean.dtype).reciprocal()
    running_mean.lerp_(mean.to(running_mean), momentum)
    unbiased = variance * (count / max(count - 1, 1))
    running_variance.lerp_(unbiased.to(running_variance), momentum)


class FoldedLayer(LinearNorm):
    """A linear map and batch normalisation that are applied as one linear map."""

    def fold(self, moments: Moments | None) -> tuple[Float[Tensor, "d c"], Float[Tensor, "d"]]:
        """Return weight and shift of the normalised map; see `fold_norm`."""
        return fold_norm(self.norm, self.linear.weight, moments)
