"""Batch normalisation across domains: whose statistics, and which channels weigh more.

Convention:
    Source and target always pass through the network apart from each other, so that in training
    each batch is normalised with its own mean and variance. The choice is whose *running*
    statistics the trained network uses, and whether channels are reweighted.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from typing import get_args

import torch
from torch import Tensor, nn
from torch.nn.modules.batchnorm import _BatchNorm

from qs3.adaptation.names import Normalisation
from qs3.errors import no_such
from qs3.models import PointClassifier

_STATISTICS = ("running_mean", "running_var", "num_batches_tracked")
_AFFINE = ("weight", "bias")


class DomainNorm(nn.Module):
    """One set of running statistics, which follows every batch of either domain.

    The network is not registered here: its method owns it.
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

    @contextmanager
    def of(self, domain: str) -> Iterator[None]:
        """Put the domain's statistics and the present α in place for a while."""
        scales = [1 + self._alpha(number) for number in range(len(self._layers))]
        with super().of(domain):
            held = []
            for layer, scale in zip(self._layers, scales, strict=True):
                for name in _AFFINE:
                    weight = layer._parameters.pop(name)
                    assert weight is not None  # noqa: S101
                    held.append((layer, name, weight))
                    # A plain attribute: the product is no parameter, its factor is.
                    object.__setattr__(layer, name, weight * scale)
            try:
                yield
            finally:
                for layer, name, weight in held:
                    object.__delattr__(layer, name)
                    layer._parameters[name] = weight

    @torch.no_grad()
    def _alpha(self, number: int) -> Tensor:
        layer, other = self._layers[number], self._other(number)
        source = (layer.running_mean, layer.running_var)
        target = (other["running_mean"], other["running_var"])
        return channel_weights(source, target, layer.eps)  # pyright: ignore[reportArgumentType]

    @torch.no_grad()
    def settle(self) -> None:
        """Multiply 1 + α into the scales and offsets, and keep the target's statistics."""
        for number, layer in enumerate(self._layers):
            scale = 1 + self._alpha(number)
            for name in _AFFINE:
                getattr(layer, name).mul_(scale)
        super().settle()


def channel_weights(
    source: tuple[Tensor, Tensor], target: tuple[Tensor, Tensor], eps: float = 1e-5
) -> Tensor:
    """Return TransNorm's α [c] of each domain's mean and variance of the channels; their mean is 1.

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
        raise no_such(f"unknown normalisation {name!r}", name, get_args(Normalisation))
    kinds = {"separate": SeparateNorm, "transnorm": TransNorm}
    return kinds.get(name, DomainNorm)(model)
