"""PointNet (Qi et al., CVPR 2017): a shared network a point, then the maximum over the points."""

import itertools
from collections.abc import Iterator

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from qs3.checks import check_numbers
from qs3.errors import InputError
from qs3.models.classifier import ClassifierHead, Features, PointClassifier, PointwiseLayer
from qs3.models.normalisation import FoldedLayer, fold_norm, row_moments, uses_batch
from qs3.models.ops.gathering import blocks, linear_max_gradients


def linear_max(
    points: Float[Tensor, "b n c"], weight: Float[Tensor, "d c"]
) -> Float[Tensor, "b d"]:
    """Take the maximum over the points of a linear map: max_n W x_n.

    The [b n d] tensor of products is made in blocks and never kept. The gradient of each output
    belongs to one point, so that going back costs 1/n of the way forth; at ties it is one of them.
    """
    if torch.is_grad_enabled() and (points.requires_grad or weight.requires_grad):
        return _LinearMax.apply(points, weight)
    if torch.compiler.is_compiling():  # blocks would fix the number of points
        return (points @ weight.t()).amax(dim=1).to(points.dtype)
    best = points.new_full((len(points), len(weight)), -torch.inf)
    for cloud, row in _blocks(points, len(weight)):
        product = _product(points[cloud, row], weight)
        best[cloud] = torch.maximum(best[cloud], product.amax(dim=2).to(best.dtype))
    return best


def _blocks(points: Tensor, width: int) -> Iterator[tuple[slice, slice]]:
    b, n, _ = points.shape
    return blocks(b, n, width, 2**26 if points.is_cuda else 2**20)


def _product(points: Float[Tensor, "b n c"], weight: Float[Tensor, "d c"]) -> Tensor:
    """Return W x_n as [b d n]; a plain ``@`` would copy it from [b n d]."""
    return torch.bmm(weight.expand(len(points), -1, -1), points.transpose(1, 2))


def _winners(product: Float[Tensor, "b d n"]) -> Int[Tensor, "b d 1"]:
    """Return the argmax of each row; on a CPU by NumPy, in a sixth of PyTorch's time."""
    if product.device.type == "cpu" and product.dtype in (torch.float32, torch.float64):
        return torch.from_numpy(product.numpy().argmax(axis=2, keepdims=True))
    return product.argmax(dim=2, keepdim=True)


class _LinearMax(torch.autograd.Function):
    """`linear_max` with the winning point of each output kept for the gradient."""

    @staticmethod
    def forward(ctx, points: Tensor, weight: Tensor) -> Tensor:
        best = points.new_full((len(points), len(weight)), -torch.inf)
        winner = torch.zeros(best.shape, dtype=torch.int64, device=points.device)
        for cloud, row in _blocks(points, len(weight)):
            product = _product(points[cloud, row], weight)
            index = _winners(product)
            value = product.gather(2, index)[:, :, 0].to(best.dtype)
            better = (value > best[cloud]) | value.isnan()  # NaN must not go unseen
            best[cloud] = torch.where(better, value, best[cloud])
            winner[cloud] = torch.where(better, index[:, :, 0] + row.start, winner[cloud])
        ctx.save_for_backward(points, weight, winner)
        return best

    @staticmethod
    @once_differentiable
    def backward(ctx, gradient: Tensor) -> tuple[Tensor, Tensor]:  # pyright: ignore[reportIncompatibleMethodOverride]
        points, weight, winner = ctx.saved_tensors
        start = torch.arange(len(points), device=winner.device)[:, None] * points.shape[1]
        rows = points.reshape(-1, points.shape[2])
        of_points, of_weight = linear_max_gradients(gradient, winner + start, rows, weight)
        return of_points.view_as(points), of_weight


def _fold(
    linear: nn.Linear, norm: nn.BatchNorm1d, points: Float[Tensor, "b n c"]
) -> tuple[Float[Tensor, "b n c"], Float[Tensor, "d c"], Float[Tensor, "d"]]:
    """Return points, weight and shift of one linear map that is both layers.

    In training the points are taken about their mean, which a cloud far from the origin needs.
    """
    points, weight = points.to(linear.weight.dtype), linear.weight
    if not uses_batch(norm):
        return points, *fold_norm(norm, weight, None)
    moments = row_moments(points.flatten(0, 1))
    about_zero = moments._replace(mean=torch.zeros_like(moments.mean))
    return points - moments.mean, *fold_norm(norm, weight, about_zero, weight @ moments.mean)


class FirstLayer(FoldedLayer):
    """`PointwiseLayer` with ReLU for few channels; moments before it are cheaper than after."""

    def forward(self, points: Float[Tensor, "b n c"]) -> Float[Tensor, "b n d"]:
        """Return the new features of each point."""
        with torch.autocast(points.device.type, enabled=False):
            points, weight, shift = _fold(self.linear, self.norm, points)
        return nn.functional.relu(nn.functional.linear(points, weight, shift), inplace=True)


class PointwiseMax(FoldedLayer):
    """Linear map at every point, batch normalisation over all points, ReLU, maximum over points.

    The function is that of `PointwiseLayer` and ``amax``. The variance of channel o over all points
    is w_oᵀ Σ w_o, with Σ the covariance of the input, so that the scale γ/σ is known before the
    product and goes into the weights; the shift and ReLU are monotone and follow the maximum.
    Neither the [b n d] product nor its gradient ever exists as a whole.
    """

    def forward(self, points: Float[Tensor, "b n c"]) -> Float[Tensor, "b d"]:
        """Return the maximum of each channel over each cloud."""
        with torch.autocast(points.device.type, enabled=False):
            points, weight, shift = _fold(self.linear, self.norm, points)
        return nn.functional.relu(linear_max(points, weight) + shift)


def _shared(widths: tuple[int, ...]) -> nn.Sequential:
    """Layers from one width to the next; the first is of the cheaper kind for coordinates."""
    pairs = itertools.pairwise(widths)
    return nn.Sequential(
        *(FirstLayer(c, d) if c == 3 else PointwiseLayer(c, d, 0.0) for c, d in pairs)
    )


class TransformNet(nn.Module):
    """T-Net: regress a [c c] matrix from the whole cloud, starting at the identity (§4.2).

    The official widths are 64, 128, 1024 of the shared layers and 512, 256 of those after pooling.
    """

    def __init__(self, channels: int, widths: tuple[int, ...], hidden: tuple[int, ...]) -> None:
        super().__init__()
        ends = (channels, *widths)
        self.shared = _shared(ends[:-1])
        self.pool = PointwiseMax(*ends[-2:])
        self.regress = ClassifierHead(widths[-1], hidden, channels * channels, 0.0, 0.0)
        last = self.regress.layers[-1]
        assert isinstance(last, nn.Linear)  # noqa: S101
        nn.init.zeros_(last.weight)
        with torch.no_grad():
            last.bias.copy_(torch.eye(channels).flatten())
        self.channels = channels

    def forward(self, points: Float[Tensor, "b n c"]) -> Float[Tensor, "b c c"]:
        """Return the matrix A of each cloud; a point x, a row, becomes x A."""
        matrix = self.regress(self.pool(self.shared(points)))
        return matrix.view(-1, self.channels, self.channels)


class PointNet(PointClassifier):
    """PointNet as published (§4.2, §5.1), with both T-Nets, or the quick form without.

    NOTE: the convolutions of the authors' release have biases; before batch normalisation they
    change nothing, and there are none here. The paper adds 0.001 ‖I − A Aᵀ‖² (Eq. 2) of the second
    T-Net to the loss; the shared training loop leaves it out, as the adaptation papers do.

    Args:
        channels: Widths of the shared layers; the second one's output, under the second T-Net, is
            ``local``. The last three are the widths of the T-Nets too.
        hidden: Widths of the head's hidden layers, and of the T-Nets'.
        transforms: Whether to use the two T-Nets; without, it is the paper's "vanilla" network.

    Example:
        >>> PointNet(10, channels=(8, 8, 16), hidden=(8,)).eval()(torch.zeros(2, 32, 3)).shape
        torch.Size([2, 10])
    """

    def __init__(
        self,
        num_classes: int,
        channels: tuple[int, ...] = (64, 64, 64, 128, 1024),
        hidden: tuple[int, ...] = (512, 256),
        dropout: float = 0.3,
        transforms: bool = True,
    ) -> None:
        super().__init__()
        if len(channels) < 3:
            raise InputError(f"channels must be three or more widths, not {channels}")
        check_numbers("channels", channels)
        layers = _shared((3, *channels[:-1]))
        self.early, self.late = layers[:2], layers[2:]
        self.pool = PointwiseMax(*channels[-2:])
        self.input_transform = TransformNet(3, channels[-3:], hidden) if transforms else None
        self.feature_transform = (
            TransformNet(channels[1], channels[-3:], hidden) if transforms else None
        )
        self.classify = ClassifierHead(channels[-1], hidden, num_classes, dropout, 0.0)

    def encode(self, points: Float[Tensor, "b n 3"]) -> Features:
        """Describe each cloud by the maximum over its points."""
        if self.input_transform is not None:
            points = points @ self.input_transform(points)
        local = self.early(points)
        if self.feature_transform is not None:
            local = local @ self.feature_transform(local)
        return Features(pooled=self.pool(self.late(local)), local=local)
