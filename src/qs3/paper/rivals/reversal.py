"""Gradient reversal (Ganin & Lempitsky, ICML 2015)."""

import torch
from jaxtyping import Float
from torch import Tensor


def reverse_gradient(x: Float[Tensor, "*shape"], coefficient: float) -> Float[Tensor, "*shape"]:
    """Return ``x``; its gradient is multiplied by −coefficient (Ganin & Lempitsky, ICML 2015).

    Layers after it minimise a loss while layers before it maximise it, in one backward pass.

    Example:
        >>> x = torch.tensor([3.0], requires_grad=True)
        >>> reverse_gradient(x, 0.5).square().backward()
        >>> x.grad
        tensor([-3.])
    """
    return _Reverse.apply(x, coefficient)


class _Reverse(torch.autograd.Function):
    @staticmethod
    def forward(ctx, x: Tensor, coefficient: float) -> Tensor:
        ctx.coefficient = coefficient
        return x.view_as(x)

    @staticmethod
    def backward(ctx, gradient: Tensor) -> tuple[Tensor, None]:  # pyright: ignore[reportIncompatibleMethodOverride]
        return gradient * -ctx.coefficient, None
