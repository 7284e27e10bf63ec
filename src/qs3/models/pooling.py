"""A layer over the points whose maximum and mean alone are wanted."""

from collections.abc import Iterator

import torch
from jaxtyping import Float
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from qs3.models.classifier import PointwiseLayer
from qs3.models.normalisation import update_running, uses_batch
from qs3.models.ops.gathering import is_exporting


def pooled_layer(
    layer: PointwiseLayer, points: Float[Tensor, "b n c"]
) -> tuple[Float[Tensor, "b d"], Float[Tensor, "b d"]]:
    """Return maximum and mean over the points of a layer's output.

    The function is that of ``layer(points)`` and two reductions, statistics in training included.
    What is stored is the product of points and weights; the normalised values, the activations and
    their gradients exist for a block of clouds at a time.

    Example:
        >>> layer = PointwiseLayer(3, 4, 0.2)
        >>> [x.shape for x in pooled_layer(layer, torch.randn(2, 8, 3))]
        [torch.Size([2, 4]), torch.Size([2, 4])]
    """
    if is_exporting():  # blocks would fix the number of clouds
        each = layer(points)
        return each.amax(dim=1), each.mean(dim=1)
    norm, weight = layer.norm, layer.linear.weight
    batch, running = uses_batch(norm), None
    if not batch:
        assert norm.running_mean is not None and norm.running_var is not None  # noqa: S101
        running = (norm.running_mean, norm.running_var)
    kind = points.device.type
    if torch.is_autocast_enabled(kind):
        half = torch.get_autocast_dtype(kind)
        points, weight = points.to(half), weight.to(half)
    with torch.autocast(kind, enabled=False):
        largest, average, mean, variance = _Pooled.apply(
            points, weight, norm.weight, norm.bias, running, norm.eps, layer.slope
        )
        if batch:
            update_running(norm, mean, variance, points.shape[0] * points.shape[1])
    return largest, average


def _blocks(points: Float[Tensor, "b n c"], width: int) -> Iterator[slice]:
    b, n, _ = points.shape
    clouds = max(1, (2**27 if points.is_cuda else 2**20) // (n * width))
    for start in range(0, b, clouds):
        yield slice(start, start + clouds)


def _tilt(value: Tensor, slope: float) -> Tensor:
    return (value > 0).to(value.dtype).mul_(1 - slope).add_(slope)


class _Pooled(torch.autograd.Function):
    """Maximum and mean over points of leaky ReLU(batch normalisation(W x)); W x alone is kept."""

    @staticmethod
    def forward(
        ctx,
        points: Tensor,
        weight: Tensor,
        scale: Tensor,
        shift: Tensor,
        running: tuple[Tensor, Tensor] | None,
        eps: float,
        slope: float,
    ) -> tuple[Tensor, ...]:
        b, n, _ = points.shape
        d = len(weight)
        learns = any(ctx.needs_input_grad)
        product = points @ weight.t() if learns or running is None else None
        if running is None:
            assert product is not None  # noqa: S101
            mean = weight.to(scale.dtype) @ points.to(scale.dtype).mean(dim=(0, 1))
            variance = torch.zeros_like(mean)
            for block in _blocks(points, d):
                variance += (product[block] - mean).square_().sum(dim=(0, 1))
            variance /= b * n
        else:
            mean, variance = (value.clone() for value in running)
        deviation = torch.rsqrt(variance + eps)
        largest, average, slopes, weighted = (scale.new_zeros((b, d)) for _ in range(4))
        winner = torch.zeros((b, d), dtype=torch.int64, device=points.device)
        for block in _blocks(points, d):
            raw = points[block] @ weight.t() if product is None else product[block]
            normed = (raw - mean).mul_(deviation)
            value = torch.addcmul(shift, normed, scale)
            if learns:
                # Sums of the leaky ReLU's slope at each point, alone and times the normed value.
                tilt = _tilt(value, slope)
                slopes[block] = tilt.sum(dim=1)
                weighted[block] = normed.mul_(tilt).sum(dim=1)
            nn.functional.leaky_relu(value, slope, inplace=True)
            largest[block], winner[block] = value.max(dim=1)
            average[block] = value.mean(dim=1)
        if learns:
            ctx.save_for_backward(
                *(points, weight, scale, shift, product, mean, deviation),
                *(largest, winner, slopes, weighted),
            )
            ctx.slope, ctx.running = slope, running is not None
        ctx.mark_non_differentiable(mean, variance)
        return largest, average, mean, variance

    @staticmethod
    @once_differentiable
    def backward(ctx, of_largest: Tensor, of_average: Tensor, *_: Tensor) -> tuple:  # pyright: ignore[reportIncompatibleMethodOverride]
        points, weight, scale, shift, product, mean, deviation, *pooled = ctx.saved_tensors
        largest, winner, slopes, weighted = pooled
        b, n, _ = points.shape
        each = of_average / n
        best = _tilt(largest, ctx.slope) * of_largest
        at_best = (product.gather(1, winner[:, None])[:, 0] - mean) * deviation
        of_shift = (each * slopes + best).sum(dim=0)
        of_scale = (each * weighted + best * at_best).sum(dim=0)
        # In training the batch's mean and deviation depend on every value too.
        share = 0.0 if ctx.running else 1.0 / (b * n)
        of_points, of_weight = torch.empty_like(points), scale.new_zeros(weight.shape)
        for block in _blocks(points, len(weight)):
            normed = (product[block] - mean).mul_(deviation)
            above = torch.addcmul(shift, normed, scale) > 0
            row = each[block, None]
            gradient = torch.where(above, row, ctx.slope * row)
            index = winner[block, None]
            gradient.scatter_(1, index, gradient.gather(1, index) + best[block, None])
            gradient.sub_(share * of_shift).addcmul_(normed, share * of_scale, value=-1)
            gradient = gradient.mul_(scale * deviation).to(weight.dtype)
            of_points[block] = gradient @ weight
            of_weight += gradient.flatten(0, 1).t() @ points[block].flatten(0, 1)
        return of_points, of_weight.to(weight.dtype), of_scale, of_shift, None, None, None
