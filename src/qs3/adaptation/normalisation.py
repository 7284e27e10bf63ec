"""Batch normalisation across domains: whose statistics, and which channels weigh more.

Convention:
    Source and target always pass through the network apart from each other, so that in training
    each batch is normalised with its own mean and variance. The choice is whose *running*
    statistics the trained network uses, and whether channels are reweighted.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Literal, get_args

import torch
from torch import Tensor, nn
from torch.nn.modules.batchnorm import _BatchNorm
from torch.nn.utils import parametrize

from qs3.errors import InputError
from qs3.models import PointClassifier

Normalisation = Literal["shared", "separate", "adabn", "transnorm"]
"""shared: running statistics follow both domains as they pass. separate: each domain has its own;
the trained network keeps the target's. adabn: as shared, then computed anew over the target
(Li et al., 2018). transnorm: as separate, and channels that differ less between the domains weigh
more (Wang et al., NeurIPS 2019)."""

_STATISTICS = ("running_mean", "running_var", "num_batches_tracked")


class DomainNorm(nn.Module):
    """How the batch normalisation layers of a network treat the two domains.

    Args:
        model: The network. It is not registered here: its method owns it.
    """

    def __init__(self, model: PointClassifier) -> None:
        super().__init__()
        self._layers = [layer for layer in model.modules() if isinstance(layer, _BatchNorm)]

    @contextmanager
    def of(self, domain: str) -> Iterator[None]:
        """Let the network meet clouds of ``domain`` for a while."""
        del domain
        yield

    def settle(self) -> None:
        """Leave plain layers behind, with the statistics that the target needs."""


class SharedNorm(DomainNorm):
    """One set of running statistics, which follows every batch of either domain."""


class SeparateNorm(DomainNorm):
    """Running statistics apart for each domain; the trained network keeps the target's."""

    def __init__(self, model: PointClassifier) -> None:
        super().__init__(model)
        for number, layer in enumerate(self._layers):
            for name in _STATISTICS:
                value = getattr(layer, name)
                assert isinstance(value, Tensor)  # noqa: S101
                self.register_buffer(f"{name}_{number}", value.clone())
        self._in_target = False

    def _other(self, number: int) -> dict[str, Tensor]:
        return {name: getattr(self, f"{name}_{number}") for name in _STATISTICS}

    def _swap(self) -> None:
        for number, layer in enumerate(self._layers):
            for name, value in self._other(number).items():
                setattr(self, f"{name}_{number}", getattr(layer, name))
                setattr(layer, name, value)
        self._in_target = not self._in_target

    @contextmanager
    def of(self, domain: str) -> Iterator[None]:
        """Put the target's statistics in place for a while."""
        if (domain == "target") == self._in_target:
            yield
            return
        self._swap()
        try:
            yield
        finally:
            self._swap()

    @torch.no_grad()
    def settle(self) -> None:
        """Copy the target's statistics into the network."""
        for number, layer in enumerate(self._layers):
            for name, value in self._other(number).items():
                getattr(layer, name).copy_(value)


class TransNorm(SeparateNorm):
    """Separate statistics; each layer's output is scaled by 1 + α, α from the domains' distance.

    With d_c = |μ_s/√(σ_s² + ε) − μ_t/√(σ_t² + ε)| of channel c, α_c = C (1 + d_c)⁻¹ / Σ (1 + d)⁻¹
    (Wang et al., NeurIPS 2019, eqs. 5 and 6); no gradient passes through α.

    NOTE: the distance is taken between running statistics in training too, where the paper takes
    those of the batches; so both domains of a step use the same α.
    """

    def __init__(self, model: PointClassifier) -> None:
        super().__init__(model)
        for number, layer in enumerate(self._layers):
            for name in ("weight", "bias"):
                mean = layer.running_mean
                assert isinstance(mean, Tensor)  # noqa: S101
                scale = _Scale(torch.full_like(mean, 2.0))
                parametrize.register_parametrization(layer, name, scale)
                self._refresh(number)

    @contextmanager
    def of(self, domain: str) -> Iterator[None]:
        """Put the domain's statistics and the present α in place for a while."""
        if not self._in_target:
            for number in range(len(self._layers)):
                self._refresh(number)
        with super().of(domain):
            yield

    @torch.no_grad()
    def _refresh(self, number: int) -> None:
        layer, other = self._layers[number], self._other(number)
        alpha = channel_weights(
            (layer.running_mean, layer.running_var),  # pyright: ignore[reportArgumentType]
            (other["running_mean"], other["running_var"]),
            layer.eps,
        )
        for scales in getattr(layer, "parametrizations", {}).values():
            scales[0].scale.copy_(1 + alpha)

    @torch.no_grad()
    def settle(self) -> None:
        """Multiply α into the scales and offsets, and keep the target's statistics."""
        for number, layer in enumerate(self._layers):
            self._refresh(number)
            for name in ("weight", "bias"):
                parametrize.remove_parametrizations(layer, name, leave_parametrized=True)
        super().settle()


class _Scale(nn.Module):
    def __init__(self, scale: Tensor) -> None:
        super().__init__()
        self.register_buffer("scale", scale)

    def forward(self, value: Tensor) -> Tensor:
        return value * self.get_buffer("scale")


def channel_weights(
    source: tuple[Tensor, Tensor], target: tuple[Tensor, Tensor], eps: float = 1e-5
) -> Tensor:
    """Return TransNorm's α of each channel; their mean is 1.

    Args:
        source: Mean and variance of each channel, [c] each.
        target: The same on the target.
        eps: Added to the variances.

    Example:
        >>> one, zero = torch.ones(2), torch.zeros(2)
        >>> channel_weights((zero, one), (torch.tensor([0.0, 1.0]), one), 0.0)
        tensor([1.3333, 0.6667])
    """
    standard = [mean / (variance + eps).sqrt() for mean, variance in (source, target)]
    closeness = 1 / (1 + (standard[0] - standard[1]).abs())
    return len(closeness) * closeness / closeness.sum()


def make_norm(name: Normalisation, model: PointClassifier) -> DomainNorm:
    """Return the treatment of a name.

    Raises:
        InputError: where the name is unknown.
    """
    if name not in get_args(Normalisation):
        raise InputError(
            f"unknown normalisation {name!r}; choose one of {', '.join(get_args(Normalisation))}"
        )
    kinds = {"separate": SeparateNorm, "transnorm": TransNorm}
    return kinds.get(name, SharedNorm)(model)
