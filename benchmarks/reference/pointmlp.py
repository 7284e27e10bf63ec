"""PointMLP-elite in its textbook form: every group is formed, [b c m k].

Ma et al., ICLR 2022, as the authors' release builds it (pointMLPElite of
https://github.com/ma-xu/pointMLP-pytorch, with the standard deviation of each cloud, the "fixstd"
form). Takes the arguments of `qs3.models.PointMLPElite`. β of the affine module and the first bias
of the head are here, though without effect before a normalisation; `from_ours` sets them to zero.
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


def nearest(centres: Tensor, points: Tensor, k: int) -> Tensor:
    return torch.cdist(centres, points).topk(k, dim=2, largest=False).indices


def pick(values: Tensor, index: Tensor) -> Tensor:
    cloud = torch.arange(len(values), device=values.device)
    return values[cloud.view(-1, *[1] * (index.ndim - 1)), index]


class Residual(nn.Module):
    """ReLU(x + BN W₂ ReLU(BN W₁ x)) on [b c ...]."""

    def __init__(self, channels: int, hidden: int) -> None:
        super().__init__()
        self.squeeze = nn.Conv2d(channels, hidden, 1, bias=False)
        self.squeeze_norm = nn.BatchNorm2d(hidden)
        self.widen = nn.Conv2d(hidden, channels, 1, bias=False)
        self.widen_norm = nn.BatchNorm2d(channels)

    def forward(self, values: Tensor) -> Tensor:
        hidden = functional.relu_(self.squeeze_norm(self.squeeze(values)))
        return functional.relu_(self.widen_norm(self.widen(hidden)) + values)


class Stage(nn.Module):
    def __init__(self, channels: int, width: int, before: int, after: int, share: float) -> None:
        super().__init__()
        hidden = int(width * share)
        self.scale = nn.Parameter(torch.ones(channels))
        self.shift = nn.Parameter(torch.zeros(channels))
        self.transfer = nn.Conv2d(2 * channels, width, 1, bias=False)
        self.transfer_norm = nn.BatchNorm2d(width)
        self.before = nn.Sequential(*(Residual(width, hidden) for _ in range(before)))
        self.after = nn.Sequential(*(Residual(width, hidden) for _ in range(after)))

    def forward(self, features: Tensor, samples: Tensor, neighbours: Tensor) -> Tensor:
        centre = pick(features, samples)[:, :, None]
        difference = pick(features, neighbours) - centre
        deviation = difference.flatten(1).std(dim=1)[:, None, None, None]
        normed = self.scale * difference / (deviation + 1e-5) + self.shift
        grouped = torch.cat([normed, centre.expand_as(normed)], dim=3).permute(0, 3, 1, 2)
        values = self.before(functional.relu_(self.transfer_norm(self.transfer(grouped))))
        best = functional.max_pool2d(values, (1, values.shape[3]))
        return self.after(best).flatten(2).transpose(1, 2)


class PointMLPElite(nn.Module):
    def __init__(
        self,
        num_classes: int,
        embedding: int = 32,
        expansions: Sequence[int] = (2, 2, 2, 1),
        before: Sequence[int] = (1, 1, 2, 1),
        after: Sequence[int] = (1, 1, 2, 1),
        neighbours: Sequence[int] = (24, 24, 24, 24),
        reducers: Sequence[int] = (2, 2, 2, 2),
        bottleneck: float = 0.25,
        hidden: Sequence[int] = (512, 256),
        dropout: float = 0.5,
    ) -> None:
        super().__init__()
        self.levels = list(zip(neighbours, reducers, strict=True))
        self.embed = nn.Conv2d(3, embedding, 1, bias=False)
        self.embed_norm = nn.BatchNorm2d(embedding)
        width, stages = embedding, []
        for factor, early, late in zip(expansions, before, after, strict=True):
            stages.append(Stage(width, width * factor, early, late, bottleneck))
            width *= factor
        self.stages = nn.ModuleList(stages)
        layers: list[nn.Module] = []
        for d in hidden:
            layers += [
                nn.Linear(width, d),
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
        for k, reducer in self.levels:
            samples = farthest_points(points, max(1, points.shape[1] // reducer), last)
            centres = pick(points, samples)
            groups.append((samples, nearest(centres, points, min(k, points.shape[1]))))
            points, last = centres, torch.zeros_like(last)
        return groups

    def forward(self, points: Tensor, groups=None) -> Tensor:
        """Return the logits; ``groups`` are samples [b m] and neighbours [b m k] of each level."""
        groups = self.group(points) if groups is None else groups
        embedded = self.embed_norm(self.embed(points.transpose(1, 2)[..., None]))
        features = functional.relu_(embedded)[..., 0].transpose(1, 2)
        for stage, (samples, neighbours) in zip(self.stages, groups, strict=True):
            features = stage(features, samples, neighbours)
        return self.classify(features.amax(dim=1))


def pairs(ours, theirs):
    """Our layers beside the textbook's: linear maps and normalisations, each with its name."""
    yield "embed", ours.embed.linear, theirs.embed
    yield "embed norm", ours.embed.norm, theirs.embed_norm
    for depth, (own, their) in enumerate(zip(ours.stages, theirs.stages, strict=True)):
        yield f"{depth} transfer", own.transfer, their.transfer
        yield f"{depth} transfer norm", own.transfer_norm, their.transfer_norm
        for part in ("before", "after"):
            blocks = zip(getattr(own, part), getattr(their, part), strict=True)
            for number, (block, textbook) in enumerate(blocks):
                for name in ("squeeze", "squeeze_norm", "widen", "widen_norm"):
                    yield (
                        f"{depth} {part} {number} {name}",
                        getattr(block, name),
                        getattr(textbook, name),
                    )
    head = [m for m in ours.classify.layers if isinstance(m, nn.Linear | nn.BatchNorm1d)]
    textbook = [m for m in theirs.classify if isinstance(m, nn.Linear | nn.BatchNorm1d)]
    for number, (own, their) in enumerate(zip(head, textbook, strict=True)):
        yield f"head {number}", own, their


@torch.no_grad()
def from_ours(model) -> PointMLPElite:
    """The textbook form with the weights and the state of a `qs3.models.PointMLPElite`."""
    linear = [layer for layer in model.classify.layers if isinstance(layer, nn.Linear)]
    slow = PointMLPElite(
        linear[-1].out_features, hidden=[d.out_features for d in linear[:-1]], **model.settings
    ).to(linear[0].weight)
    for own, their in zip(model.stages, slow.stages, strict=True):
        their.scale.copy_(own.scale)
    for _, own, their in pairs(model, slow):
        if not isinstance(own, nn.Linear):
            their.load_state_dict(own.state_dict())
            continue
        their.weight.copy_(own.weight.view_as(their.weight))
        if their.bias is not None:
            their.bias.copy_(torch.zeros_like(their.bias) if own.bias is None else own.bias)
    return slow.train(model.training)
