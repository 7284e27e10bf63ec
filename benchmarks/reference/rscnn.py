"""RS-CNN, single scale, in its textbook form: explicit [b c m k] tensors.

Liu et al., CVPR 2019, as the authors' release builds it (rscnn_ssn_cls of
https://github.com/Yochengliu/Relation-Shape-CNN). Takes the arguments of `qs3.models.RSCNN`. The
release's biases before batch normalisations are here, though they have no effect; `from_ours`
leaves them at zero.
"""

from collections.abc import Sequence

import torch
from torch import Tensor, nn
from torch.nn import functional


def farthest_points(points: Tensor, m: int, last: Tensor) -> Tensor:
    b, n, _ = points.shape
    cloud = torch.arange(b, device=points.device)
    distance = points.new_full((b, n), torch.inf)
    chosen = []
    for _ in range(m):
        chosen.append(last)
        here = points[cloud, last][:, None]
        distance = torch.minimum(distance, (points - here).square().sum(dim=2))
        last = distance.argmax(dim=1)
    return torch.stack(chosen, dim=1)


def group(values: Tensor, index: Tensor) -> Tensor:
    """Values [b n c] at indices [b m k] as [b c m k]."""
    cloud = torch.arange(len(values), device=values.device)[:, None, None]
    return values[cloud, index].permute(0, 3, 1, 2)


def ball(points: Tensor, samples: Tensor, radius: float, k: int, order: str) -> Tensor:
    """The centre itself, then at most k others within the radius, filled up with the centre."""
    centres = points.gather(1, samples[:, :, None].expand(-1, -1, 3))
    distance = torch.cdist(centres, points, compute_mode="donot_use_mm_for_euclid_dist")
    number = torch.arange(points.shape[1], device=points.device)
    outside = (distance > radius) | (number == samples[:, :, None])
    rank = (distance if order == "nearest" else number.to(distance)).masked_fill(outside, torch.inf)
    value, index = rank.topk(min(k, points.shape[1] - 1), dim=2, largest=False)
    index = torch.where(value.isinf(), samples[:, :, None], index)
    return torch.cat([samples[:, :, None], index], dim=2)


class RSConv(nn.Module):
    def __init__(self, channels: int, width: int, first: bool) -> None:
        super().__init__()
        hidden = width // 2 if first else width // 4
        inner = 16 if first else channels + 3
        self.mapping1 = nn.Conv2d(10, hidden, 1)
        self.norm_mapping = nn.BatchNorm2d(hidden)
        self.mapping2 = nn.Conv2d(hidden, inner, 1)
        self.raise_xyz = nn.Conv2d(3, inner, 1) if first else None
        self.norm_xyz = nn.BatchNorm2d(inner) if first else None
        self.norm_product = nn.BatchNorm2d(inner)
        self.raise_channels = nn.Conv1d(inner, width, 1)
        self.norm_raised = nn.BatchNorm1d(width)

    def forward(self, points, features, samples, neighbours, relative):
        around = group(points, neighbours)
        centre = group(points, samples[:, :, None])
        difference = around - centre
        if relative:
            around, centre = difference, centre * 0
        relation = torch.cat(
            [difference.norm(dim=1, keepdim=True), centre.expand_as(around), around, difference],
            dim=1,
        )
        mapped = functional.relu_(self.norm_mapping(self.mapping1(relation)))
        mapped = self.mapping2(mapped)
        if self.raise_xyz is not None and self.norm_xyz is not None:
            value = functional.relu_(self.norm_xyz(self.raise_xyz(difference)))
        else:
            value = torch.cat([difference, group(features, neighbours)], dim=1)
        product = functional.relu_(self.norm_product(mapped * value))
        best = functional.max_pool2d(product, (1, product.shape[3])).squeeze(3)
        raised = functional.relu_(self.norm_raised(self.raise_channels(best)))
        return raised.transpose(1, 2)


class RSCNN(nn.Module):
    def __init__(
        self,
        num_classes: int,
        centres: Sequence[int] = (512, 128),
        radii: Sequence[float] = (0.23, 0.32),
        neighbours: Sequence[int] = (48, 64),
        channels: Sequence[int] = (128, 512),
        embedding: int = 1024,
        hidden: Sequence[int] = (512, 256),
        dropout: float = 0.5,
        ball_order: str = "nearest",
        coordinates: str = "absolute",
    ) -> None:
        super().__init__()
        self.levels = list(zip(centres, radii, neighbours, strict=True))
        self.ball_order = ball_order
        self.relative = coordinates == "relative"
        widths = (0, *channels)
        self.convolutions = nn.ModuleList(
            RSConv(c, d, depth == 0)
            for depth, (c, d) in enumerate(zip(widths, channels, strict=False))
        )
        self.embed = nn.Conv2d(3 + channels[-1], embedding, 1)
        self.norm_embed = nn.BatchNorm2d(embedding)
        layers: list[nn.Module] = []
        width = embedding
        for d in hidden:
            layers += [
                nn.Linear(width, d, bias=len(layers) > 0),
                nn.BatchNorm1d(d),
                nn.ReLU(inplace=True),
                nn.Dropout(dropout),
            ]
            width = d
        self.classify = nn.Sequential(*layers, nn.Linear(width, num_classes))

    @torch.no_grad()
    def group(self, points: Tensor) -> list[tuple[Tensor, Tensor]]:
        groups = []
        last = (points - points.mean(dim=1, keepdim=True)).square().sum(dim=2).argmax(dim=1)
        for centres, radius, k in self.levels:
            samples = farthest_points(points, min(centres, points.shape[1]), last)
            last = torch.zeros_like(last)
            groups.append((samples, ball(points, samples, radius, k, self.ball_order)))
            points = points.gather(1, samples[:, :, None].expand(-1, -1, 3))
        return groups

    def forward(self, points: Tensor, groups=None) -> Tensor:
        """Return the logits; ``groups`` are samples [b m] and neighbours [b m k] of each level."""
        groups = self.group(points) if groups is None else groups
        features = None
        for convolution, (samples, neighbours) in zip(self.convolutions, groups, strict=True):
            features = convolution(points, features, samples, neighbours, self.relative)
            points = points.gather(1, samples[:, :, None].expand(-1, -1, 3))
        every = torch.cat([points, features], dim=2).transpose(1, 2)[:, :, None]
        embedded = functional.relu_(self.norm_embed(self.embed(every)))
        pooled = functional.max_pool2d(embedded, (1, embedded.shape[3])).flatten(1)
        return self.classify(pooled)


PAIRS = (("mapping1", "relate"), ("mapping2", "weigh"), ("raise_channels", "raise_channels"))
NORMS = (("norm_mapping", "relate_norm"), ("norm_product", "norm"), ("norm_raised", "raise_norm"))


def copy(layer: nn.Module, own: nn.Module) -> None:
    """Copy a linear layer's values; a bias that ours leaves out is set to zero."""
    with torch.no_grad():
        layer.weight.copy_(own.weight.view_as(layer.weight))
        if layer.bias is not None:
            if own.bias is None:
                layer.bias.zero_()
            else:
                layer.bias.copy_(own.bias)


def from_ours(model) -> RSCNN:
    """The textbook form with the weights and the state of a `qs3.models.RSCNN`."""
    linear = [layer for layer in model.classify.layers if isinstance(layer, nn.Linear)]
    slow = RSCNN(
        linear[-1].out_features,
        centres=model.centres,
        radii=model.radii,
        neighbours=model.neighbours,
        channels=model.channels,
        embedding=model.embed.out_features,
        hidden=[layer.out_features for layer in linear[:-1]],
        dropout=model.dropout,
        ball_order=model.ball_order,
        coordinates=model.coordinates,
    ).to(linear[0].weight)
    for theirs, ours in zip(slow.convolutions, model.convolutions, strict=True):
        for name, own in PAIRS:
            copy(getattr(theirs, name), getattr(ours, own))
        for name, own in NORMS:
            getattr(theirs, name).load_state_dict(getattr(ours, own).state_dict())
        if theirs.raise_xyz is not None:
            copy(theirs.raise_xyz, ours.raise_xyz)
            theirs.norm_xyz.load_state_dict(ours.xyz_norm.state_dict())
    copy(slow.embed, model.embed)
    slow.norm_embed.load_state_dict(model.embed_norm.state_dict())
    modules = [m for m in slow.classify if isinstance(m, nn.Linear | nn.BatchNorm1d)]
    own = [m for m in model.classify.layers if isinstance(m, nn.Linear | nn.BatchNorm1d)]
    for theirs, ours in zip(modules, own, strict=True):
        if isinstance(theirs, nn.Linear):
            copy(theirs, ours)
        else:
            theirs.load_state_dict(ours.state_dict())
    return slow.train(model.training)
