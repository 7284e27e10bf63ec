"""DGCNN in its textbook form: Conv2d and BatchNorm2d on the edge tensor [b 2c n k].

Wang et al., TOG 2019, as the authors' release builds it (https://github.com/WangYueFt/dgcnn).
"""

import itertools
from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional

SLOPE = 0.2


def nearest(values: Tensor, k: int) -> Tensor:
    """The k nearest of each column of [b c n], as [b n k]."""
    inner = values.transpose(1, 2) @ values
    squared = values.square().sum(dim=1, keepdim=True)
    distance = squared.transpose(1, 2) - 2 * inner + squared
    return distance.topk(k, dim=2, largest=False).indices


def edges(values: Tensor, neighbours: Tensor) -> Tensor:
    """(x_j − x_i, x_i) of every edge: [b c n] to [b 2c n k]."""
    b, c, n = values.shape
    k = neighbours.shape[2]
    start = torch.arange(b, device=values.device)[:, None, None] * n
    rows = values.transpose(1, 2).reshape(b * n, c)
    around = rows[(neighbours + start).view(-1)].view(b, n, k, c)
    centre = rows.view(b, n, 1, c).expand(b, n, k, c)
    return torch.cat([around - centre, centre], dim=3).permute(0, 3, 1, 2).contiguous()


class EdgeConv(nn.Module):
    def __init__(self, channels: int, width: int) -> None:
        super().__init__()
        self.convolution = nn.Conv2d(2 * channels, width, 1, bias=False)
        self.norm = nn.BatchNorm2d(width)

    def forward(self, values: Tensor, neighbours: Tensor) -> Tensor:
        """From [b c n] to [b d n]."""
        every = self.norm(self.convolution(edges(values, neighbours)))
        return functional.leaky_relu(every, SLOPE).amax(dim=3)


class DGCNN(nn.Module):
    def __init__(
        self,
        num_classes: int,
        neighbours: int = 20,
        channels: tuple[int, ...] = (64, 64, 128, 256),
        embedding: int = 1024,
        hidden: tuple[int, ...] = (512, 256),
        dropout: float = 0.5,
        plain: bool = False,
    ) -> None:
        """``plain``: QS³'s release, which neither normalises nor activates the last convolution."""
        super().__init__()
        self.neighbours = neighbours
        pairs = itertools.pairwise((3, *channels))
        self.convolutions = nn.ModuleList(EdgeConv(c, d) for c, d in pairs)
        self.embed = nn.Sequential(nn.Conv1d(sum(channels), embedding, 1, bias=False))
        if not plain:
            self.embed.extend([nn.BatchNorm1d(embedding), nn.LeakyReLU(SLOPE)])
        layers: list[nn.Module] = []
        for depth, (c, d) in enumerate(itertools.pairwise((2 * embedding, *hidden))):
            layers += [nn.Linear(c, d, bias=depth > 0), nn.BatchNorm1d(d)]
            layers += [nn.LeakyReLU(SLOPE), nn.Dropout(dropout)]
        width = hidden[-1] if hidden else 2 * embedding
        self.classify = nn.Sequential(*layers, nn.Linear(width, num_classes))

    def forward(self, points: Tensor, graphs: Sequence[Tensor] | None = None) -> Tensor:
        """Return the logits; ``graphs`` are the neighbours [b n k] of each EdgeConv."""
        k = min(self.neighbours, points.shape[1])
        values = points.transpose(1, 2)
        levels = []
        for level, convolution in enumerate(self.convolutions):
            neighbours = nearest(values, k) if graphs is None else graphs[level]
            values = convolution(values, neighbours)
            levels.append(values)
        every = self.embed(torch.cat(levels, dim=1))
        largest = functional.adaptive_max_pool1d(every, 1).squeeze(2)
        mean = functional.adaptive_avg_pool1d(every, 1).squeeze(2)
        return self.classify(torch.cat([largest, mean], dim=1))


def pairs(ours: nn.Module, textbook: DGCNN) -> list[tuple[nn.Module, nn.Module]]:
    """Layers that mean the same, ours first."""
    kinds = (nn.Linear, nn.Conv1d, nn.Conv2d, nn.BatchNorm1d, nn.BatchNorm2d)

    def plain(module: nn.Module) -> list[nn.Module]:
        return [m for part in ("convolutions", "embed", "classify")
                for m in getattr(module, part).modules() if isinstance(m, kinds)]  # fmt: skip

    return list(zip(plain(ours), plain(textbook), strict=True))


@torch.no_grad()
def from_ours(model: nn.Module) -> DGCNN:
    """The textbook form with the weights, statistics, type and mode of a `qs3.models.DGCNN`."""
    linears = [m for m in model.classify.layers if isinstance(m, nn.Linear)]
    dropouts = [m.p for m in model.classify.layers if isinstance(m, nn.Dropout)]
    plain = isinstance(model.embed, nn.Linear)
    textbook = DGCNN(
        linears[-1].out_features,
        model.neighbours,
        tuple(layer.linear.out_features for layer in model.convolutions),
        (model.embed if plain else model.embed.linear).out_features,
        tuple(layer.out_features for layer in linears[:-1]),
        dropouts[0] if dropouts else 0.0,
        plain,
    ).to(linears[-1].weight)
    for fast, slow in pairs(model, textbook):
        target = slow.state_dict()
        assert target.keys() == fast.state_dict().keys()
        for name, value in fast.state_dict().items():
            target[name].copy_(value.view_as(target[name]))
    return textbook.train(model.training)
