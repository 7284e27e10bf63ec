"""A shared network over the points of each group, then the maximum over the group.

The function is the textbook's: a linear map, batch normalisation and ReLU at every (centre,
neighbour) edge, several times, then the maximum over the neighbours (Qi et al., NeurIPS 2017).
The differences, for speed and memory:

- Batch normalisation never runs over the edges. A linear layer's output has mean W μ and variances
  w_oᵀ Σ w_o, where μ and Σ are mean and covariance of its input; scale and shift then go into the
  weights, and each layer is one product with a ReLU in place.
- The first layer is linear in (x_j − c_i, f_j): its product is made once a point and once a centre.
- The last layer's output, the widest, exists for one neighbour of every centre at a time: the
  running maximum and the number of its neighbour (a byte) stay. Backward, only the winners count.

Convention:
    Edges are neighbour first, [k m c] with the centres of all clouds in m, so that a slice holds
    one neighbour of every centre.
"""

import itertools

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn
from torch.autograd.function import once_differentiable

from qs3.errors import InputError
from qs3.models.normalisation import FoldedLayer, Moments, uses_batch
from qs3.models.ops import flat_indices, gather_points, scatter_points
from qs3.models.ops.gathering import is_exporting, linear_max_gradients


class GroupedMLP(nn.Module):
    """Two or more shared layers over the points of each group, and the maximum over each group.

    ``channels`` is the width of the points' features, 0 if they have none.
    """

    def __init__(self, channels: int, widths: tuple[int, ...]) -> None:
        super().__init__()
        if len(widths) < 2:
            raise InputError(f"widths must be two or more, not {widths}")
        ends = (3 + channels, *widths)
        self.layers = nn.ModuleList(FoldedLayer(c, d) for c, d in itertools.pairwise(ends))

    def forward(
        self,
        points: Float[Tensor, "b n 3"],
        features: Float[Tensor, "b n c"] | None,
        centres: Float[Tensor, "b m 3"],
        index: Int[Tensor, "b m k"],
    ) -> Float[Tensor, "b m d"]:
        """Describe each group; ``index`` counts within the own cloud, k is at most 255."""
        b, m, k = index.shape
        if k > 255:
            raise ValueError(f"at most 255 neighbours, not {k}")
        with torch.autocast(points.device.type, enabled=False):
            dtype = self._layer(0).linear.weight.dtype
            mean = points.mean(dim=1, keepdim=True)
            points, centres = (points - mean).to(dtype), (centres - mean).to(dtype)
            features = None if features is None else features.to(dtype)
            first = _FirstInput(points, features, centres, index)
            batch = any(uses_batch(self._layer(i).norm) for i in range(len(self.layers)))
            if batch or torch.is_grad_enabled() or is_exporting():
                best = self._all_edges(first)
            else:
                best = self._one_neighbour_at_a_time(first, k)
        return best.view(b, m, -1)

    def _layer(self, depth: int) -> FoldedLayer:
        layer = self.layers[depth]
        assert isinstance(layer, FoldedLayer)  # noqa: S101
        return layer

    def _all_edges(self, first: "_FirstInput") -> Float[Tensor, "r d"]:
        batch = uses_batch(self._layer(0).norm)
        hidden = first.apply(*self._layer(0).fold(first.moments() if batch else None))
        for depth in range(1, len(self.layers)):
            moments = None
            if uses_batch(self._layer(depth).norm):
                hidden, mean, covariance = _WithMoments.apply(hidden)
                moments = Moments(mean, covariance, hidden.shape[0] * hidden.shape[1])
            weight, shift = self._layer(depth).fold(moments)
            if depth < len(self.layers) - 1:
                hidden = _rectified(hidden, weight, shift)
            elif is_exporting():
                hidden = (hidden @ weight.t()).amax(dim=0).add(shift).relu_()
            else:
                hidden = _LinearMax.apply(hidden, weight).add(shift).relu_()
        return hidden

    def _one_neighbour_at_a_time(self, first: "_FirstInput", k: int) -> Float[Tensor, "r d"]:
        folded = [self._layer(depth).fold(None) for depth in range(len(self.layers))]
        best = None
        for t in range(k):
            value = first.apply(*folded[0], neighbour=t)[0]
            for weight, shift in folded[1:-1]:
                value = _rectified(value[None], weight, shift)[0]
            value = torch.mm(value, folded[-1][0].t())
            best = value if best is None else torch.maximum(best, value, out=best)
        assert best is not None  # noqa: S101
        return best.add_(folded[-1][1]).relu_()


class _FirstInput:
    """The input (x_j − c_i, f_j) of the first layer, of which only the differences are made."""

    def __init__(
        self,
        points: Float[Tensor, "b n 3"],
        features: Float[Tensor, "b n c"] | None,
        centres: Float[Tensor, "b m 3"],
        index: Int[Tensor, "b m k"],
    ) -> None:
        self.points, self.features, self.centres = points, features, centres
        self.index = index
        self.differences = gather_points(points, index) - centres[:, :, None]
        self._products: tuple[Tensor, Tensor] | None = None

    def moments(self) -> Moments:
        """Return mean and covariance of the input over all edges."""
        count = self.index.numel()
        differences = self.differences.reshape(count, 3)
        mean = differences.mean(dim=0)
        centred = differences - mean
        covariance = centred.t() @ centred / count
        if self.features is None:
            return Moments(mean, covariance, count)
        n = self.features.shape[1]
        features = self.features.flatten(0, 1)
        flat = flat_indices(self.index, n).view(-1)
        share = torch.bincount(flat, minlength=len(features)).to(features.dtype) / count
        feature_mean = share @ features
        features = features - feature_mean
        scatter = (share[:, None] * features).t() @ features
        # Σ_e d_e f_jᵀ, summed over the edges that end in a point first.
        around = scatter_points(centred.view(*self.index.shape, 3), self.index, n).flatten(0, 1)
        cross = around.t() @ features / count
        rows = [torch.cat([covariance, cross], dim=1), torch.cat([cross.t(), scatter], dim=1)]
        return Moments(torch.cat([mean, feature_mean]), torch.cat(rows), count)

    def apply(
        self, weight: Float[Tensor, "d c"], shift: Float[Tensor, "d"], neighbour: int | None = None
    ) -> Float[Tensor, "k r d"]:
        """Return ReLU of the linear map at every edge, or at those of one neighbour."""
        pick = slice(None) if neighbour is None else slice(neighbour, neighbour + 1)
        b, m, _ = self.index.shape
        if self.features is None:
            edges = self.differences[:, :, pick].permute(2, 0, 1, 3).reshape(-1, b * m, 3)
            return _rectified(edges, weight, shift)
        n = self.features.shape[1]
        if self._products is None:
            inputs = torch.cat([self.points, self.features], dim=2)
            of_points = nn.functional.linear(inputs, weight, shift).flatten(0, 1)
            of_centres = nn.functional.linear(self.centres, weight[:, :3]).flatten(0, 1)
            self._products = of_points, of_centres
        flat = flat_indices(self.index, n)[:, pick].t()
        of_points, of_centres = self._products
        return nn.functional.embedding(flat, of_points).sub_(of_centres).relu_()


def _rectified(
    edges: Float[Tensor, "k r c"], weight: Float[Tensor, "d c"], shift: Float[Tensor, "d"]
) -> Float[Tensor, "k r d"]:
    rows = torch.addmm(shift, edges.reshape(-1, edges.shape[2]), weight.t()).relu_()
    return rows.view(*edges.shape[:2], -1)


class _WithMoments(torch.autograd.Function):
    """Hand edges on, with their mean and covariance; one product forward and one backward."""

    @staticmethod
    def forward(ctx, edges: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        rows = edges.view(-1, edges.shape[-1])
        mean = rows.mean(dim=0)
        covariance = torch.zeros((len(mean), len(mean)), dtype=rows.dtype, device=rows.device)
        for block in rows.split(max(1, (2**26 if rows.is_cuda else 2**20) // rows.shape[1])):
            centred = block - mean
            covariance.addmm_(centred.t(), centred)
        ctx.save_for_backward(edges, mean)
        return edges.view_as(edges), mean, covariance.div_(len(rows))

    @staticmethod
    @once_differentiable
    def backward(ctx, gradient: Tensor, of_mean: Tensor, of_covariance: Tensor) -> Tensor:  # pyright: ignore[reportIncompatibleMethodOverride]
        edges, mean = ctx.saved_tensors
        rows = edges.view(-1, edges.shape[-1])
        slope = (of_covariance + of_covariance.t()) / len(rows)
        total = torch.addmm(gradient.reshape(rows.shape), rows, slope)
        return total.add_(of_mean / len(rows) - mean @ slope).view_as(edges)


class _LinearMax(torch.autograd.Function):
    """max_t W x_tm of edges [k m c], without the [k m d] tensor of the products."""

    @staticmethod
    def forward(ctx, edges: Tensor, weight: Tensor) -> Tensor:
        across = weight.t().contiguous()
        best = edges[0] @ across
        winner = torch.zeros(best.shape, dtype=torch.uint8, device=best.device)
        value, better = torch.zeros_like(best), torch.zeros_like(winner)
        for t in range(1, len(edges)):
            torch.mm(edges[t], across, out=value)
            # A later t is larger, so that a maximum of bytes records the last improvement.
            torch.gt(value, best, out=better)
            torch.maximum(winner, better.mul_(t), out=winner)
            torch.maximum(best, value, out=best)
        ctx.save_for_backward(edges, weight, winner)
        return best

    @staticmethod
    @once_differentiable
    def backward(ctx, gradient: Tensor) -> tuple[Tensor, Tensor]:  # pyright: ignore[reportIncompatibleMethodOverride]
        edges, weight, winner = ctx.saved_tensors
        k, m, c = edges.shape
        source = winner.long().mul_(m).add_(torch.arange(m, device=winner.device)[:, None])
        rows = edges.view(k * m, c)
        of_edges, of_weight = linear_max_gradients(gradient, source, rows, weight)
        return of_edges.view_as(edges), of_weight
