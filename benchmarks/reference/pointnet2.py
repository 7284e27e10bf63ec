"""Textbook PointNet++ (Qi et al., NeurIPS 2017): explicit groups, Conv2d and BatchNorm2d.

For tests and comparisons of time and memory. Sampling and groups are the release's, which depend on
the order of the points; given the same groups the function is that of `qs3.models.PointNet2`.
"""

import itertools

import torch
from torch import Tensor, nn

SCALES = ((0.2, 32, (64, 64, 128)), (0.4, 64, (128, 128, 256)))


def pick(values: Tensor, index: Tensor) -> Tensor:
    cloud = torch.arange(len(values), device=values.device)
    return values[cloud.view(-1, *[1] * (index.ndim - 1)), index]


def sample(points: Tensor, m: int) -> Tensor:
    """Farthest points, beginning with the first of the cloud, as the release does."""
    b, n, _ = points.shape
    newest = torch.zeros(b, dtype=torch.int64, device=points.device)
    nearest = torch.full((b, n), torch.inf, dtype=points.dtype, device=points.device)
    chosen = []
    for _ in range(m):
        chosen.append(newest)
        position = points[torch.arange(b, device=points.device), newest][:, None]
        nearest = torch.minimum(nearest, (points - position).square().sum(dim=2))
        newest = nearest.argmax(dim=1)
    return torch.stack(chosen, dim=1)


def ball(points: Tensor, centres: Tensor, radius: float, k: int) -> Tensor:
    """The first k points of the cloud within the radius, in its order; too few: the first again."""
    n = points.shape[1]
    inside = (centres[:, :, None] - points[:, None]).square().sum(dim=3) < radius**2
    order = torch.where(inside, torch.arange(n, device=points.device), n)
    first = order.sort(dim=2).values[..., :k]
    return torch.where(first < n, first, first[..., :1])


def shared(channels: int, widths: tuple[int, ...]) -> nn.Sequential:
    layers: list[nn.Module] = []
    for c, d in itertools.pairwise((channels, *widths)):
        layers += [nn.Conv2d(c, d, 1, bias=False), nn.BatchNorm2d(d), nn.ReLU()]
    return nn.Sequential(*layers)


class PointNet2(nn.Module):
    """Takes the arguments of `qs3.models.PointNet2`.

    ``groups``, if set, holds for each level the indices of the centres and of their groups, in
    place of the network's own sampling and ball query.
    """

    def __init__(
        self,
        num_classes: int,
        centres: tuple[int, ...] = (512, 128),
        scales: tuple = SCALES,
        embedding: tuple[int, ...] = (256, 512, 1024),
        hidden: tuple[int, ...] = (512, 256),
        dropout: float = 0.5,
    ) -> None:
        super().__init__()
        self.centres, self.scales = centres, scales
        channels = 0
        self.levels = nn.ModuleList()
        for _, _, widths in scales:
            self.levels.append(shared(3 + channels, widths))
            channels = widths[-1]
        self.embed = shared(3 + channels, embedding)
        layers: list[nn.Module] = []
        for depth, (c, d) in enumerate(itertools.pairwise((embedding[-1], *hidden))):
            layers += [nn.Linear(c, d, bias=depth > 0), nn.BatchNorm1d(d), nn.ReLU()]
            layers += [nn.Dropout(dropout)]
        self.classify = nn.Sequential(*layers, nn.Linear((embedding[-1], *hidden)[-1], num_classes))
        self.groups: list[tuple[Tensor, Tensor]] | None = None

    def forward(self, points: Tensor) -> Tensor:
        features = None
        for depth, level in enumerate(self.levels):
            chosen, index = self.grouped(points, depth)
            centres = pick(points, chosen)
            edges = pick(points, index) - centres[:, :, None]
            if features is not None:
                edges = torch.cat([edges, pick(features, index)], dim=3)
            points, features = centres, level(edges.permute(0, 3, 1, 2)).amax(dim=3).transpose(1, 2)
        both = torch.cat([points, features], dim=2).transpose(1, 2)[..., None]
        return self.classify(self.embed(both).amax(dim=(2, 3)))

    def grouped(self, points: Tensor, depth: int) -> tuple[Tensor, Tensor]:
        if self.groups is not None:
            return self.groups[depth]
        with torch.no_grad():
            n = points.shape[1]
            chosen = sample(points, min(self.centres[depth], n))
            radius, k, _ = self.scales[depth]
            return chosen, ball(points, pick(points, chosen), radius, min(k, n))


def from_ours(model: nn.Module) -> PointNet2:
    """Return the textbook form with the weights, the type and the mode of ours."""
    layers = list(model.classify.layers)
    textbook = PointNet2(
        layers[-1].out_features,
        tuple(level.centres for level in model.levels),
        tuple(
            (
                level.radius,
                level.neighbours,
                tuple(layer.linear.out_features for layer in level.network.layers),
            )
            for level in model.levels
        ),
        tuple(layer.linear.out_features for layer in model.embed),
        tuple(layer.out_features for layer in layers[:-1] if isinstance(layer, nn.Linear)),
        next((layer.p for layer in layers if isinstance(layer, nn.Dropout)), 0.0),
    )
    ours = list(model.state_dict().values())
    textbook.to(ours[0])
    state = textbook.state_dict()
    pairs = zip(state.items(), ours, strict=True)
    textbook.load_state_dict({key: v.reshape(old.shape) for (key, old), v in pairs})
    return textbook.train(model.training)
