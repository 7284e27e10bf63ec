"""The textbook forms of `benchmarks/reference`, which are written apart from ours."""

import copy
import importlib
import sys
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from qs3.models import create_model
from qs3.models.ops import ball_query, farthest_point_sampling, gather_points, knn
from qs3.paper.networks.simpleview import depth_images

sys.path.append(str(Path(__file__).parents[2] / "benchmarks"))
_DGCNN = {"neighbours": 7, "channels": (16, 16, 24), "embedding": 32, "hidden": (16, 8)}
_POINTNET = {"channels": (8, 8, 8, 12, 32), "hidden": (16, 8)}
NETWORKS: dict[str, dict[str, Any]] = {
    "dgcnn": _DGCNN,
    "dgcnn of qs3's release": _DGCNN | {"variant": "qs3"},
    "pointnet": _POINTNET,
    "pointnet without transforms": _POINTNET | {"transforms": False},
    "pointnet-sa": {
        "channels": (8, 12, 16, 24), "transform_hidden": (16, 8), "hidden": (8,), "nodes": 10,
        "neighbours": 7, "radius": 0.5, "node_width": 6,
    },
    "pointnet2": {
        "centres": (24, 8), "scales": ((0.5, 8, (8, 8, 16)), (0.9, 6, (16, 16, 24))),
        "embedding": (16, 32), "hidden": (16, 8),
    },
    "simpleview": {"width": 4, "resolution": 24},
}  # fmt: skip
"""Small networks that have a textbook form."""
SMALL: dict[str, dict[str, Any]] = {
    "dgcnn": {"neighbours": 6, "channels": (8, 8, 16), "embedding": 32, "hidden": (16, 8)},
    "pointnet": {"channels": (8, 8, 16), "hidden": (16, 8)},
    "pointnet without transforms": {"channels": (8, 8, 16), "transforms": False},
    "pointnet-sa": {
        "channels": (8, 8, 16, 16), "transform_hidden": (16, 8), "nodes": 12, "neighbours": 6,
        "radius": 0.9, "node_width": 8,
    },
    "pointnet2": {
        "centres": (12, 5), "scales": ((0.9, 6, (8, 8, 16)), (1.4, 4, (16, 16))),
        "embedding": (16, 24), "hidden": (16, 8), "local": True,
    },
    "rscnn": {
        "centres": (12, 5), "radii": (0.9, 1.4), "neighbours": (6, 4), "channels": (8, 16),
        "embedding": 16, "hidden": (16, 8),
    },
    "simpleview": {"width": 2, "resolution": 24},
}  # fmt: skip
"""One of every network, and of some kinds of it."""


def textbook(name: str) -> ModuleType:
    """Load the module of a network."""
    return importlib.import_module(f"reference.{name.replace('-', '_')}")


def randomise(model: nn.Module, spread: float = 1.0, most: float = 2.0) -> None:
    """Give every normalisation a scale of either sign, a shift and statistics of its own.

    Layers that start at zero, and let nothing pass, get weights.
    """
    with torch.no_grad():
        for layer in model.modules():
            if isinstance(layer, nn.BatchNorm1d | nn.BatchNorm2d):
                layer.weight.normal_()
                layer.bias.normal_()
                layer.running_mean.normal_(std=spread)
                layer.running_var.uniform_(0.5, most)
            elif isinstance(layer, nn.Linear) and not layer.weight.any():
                layer.weight.normal_(std=0.05)


def make(name: str, **settings: Any) -> Any:
    """One of `NETWORKS` in double precision, none of its layers as at the start."""
    # With seeds 0, 3 and 7 a ReLU of SimpleView's textbook form, rounded, falls on its other side.
    torch.manual_seed(6 if "simpleview" in name else 0)
    model = create_model(name.split()[0], 5, **NETWORKS[name] | {"dropout": 0.0} | settings)
    model.double()
    randomise(model, 0.3 if "simpleview" in name else 1.0)
    return model


def clouds(kind: str = "plain", b: int = 8, n: int = 60) -> Tensor:
    """Clouds in double precision, mostly in the unit ball."""
    generator = torch.Generator().manual_seed(1)
    points = 0.4 * torch.randn(b, n, 3, generator=generator, dtype=torch.float64)
    if kind == "repeated":
        return points[:, : n // 3].repeat(1, 3, 1)
    few = {"one": 1, "two": 2, "few": 4}
    return points[:, : few.get(kind, n)].contiguous() + 30 * (kind == "far")


def groups(model: Any, points: Tensor) -> list[tuple[Tensor, Tensor]]:
    """Centres of each level of PointNet++ and the points around them."""
    result = []
    for level in model.levels:
        chosen = farthest_point_sampling(points, min(level.centres, points.shape[1]))
        centres, ball = level.group(points)
        result.append((chosen, ball))
        points = centres
    return result


def textbook_of(name: str, model: Any, points: Tensor) -> tuple[Any, Callable[[Tensor], Tensor]]:
    """The textbook form of ours in double precision, and it as a function with ours' neighbours.

    So it adds no rounding of its own.
    """
    slow = textbook(name.split()[0]).from_ours(model).double()
    if name.startswith("pointnet2"):
        slow.groups = groups(model, points)
    if name.startswith("pointnet-sa"):
        node, n = model.sa_node, points.shape[1]
        chosen = farthest_point_sampling(points, min(node.nodes, n))
        start = gather_points(points, chosen)
        balls = ball_query(points, start, node.radius, min(node.neighbours, n))
        slow.sa_node.groups = chosen, balls
    if name.startswith("dgcnn"):
        twin, features, graphs = copy.deepcopy(model), points, []  # whose statistics may move
        with torch.no_grad():
            for convolution in twin.convolutions:
                graphs.append(knn(features, min(model.neighbours, points.shape[1])))
                features = convolution(features, graphs[-1])
        return slow, lambda cloud: slow(cloud, graphs)
    if name.startswith("simpleview"):
        images = depth_images(points, model.resolution).double()
        return slow, lambda cloud: slow(cloud, images)
    return slow, slow


def normed(layer, rows):
    """Batch normalisation in NumPy, by a layer's own mode."""
    mean, variance = layer.running_mean.numpy(), layer.running_var.numpy()
    if layer.training:
        mean, variance = rows.mean(axis=0), rows.var(axis=0)
    weight, bias = layer.weight.detach().numpy(), layer.bias.detach().numpy()
    return (rows - mean) / np.sqrt(variance + layer.eps) * weight + bias


def error(value: Tensor, reference: Tensor) -> float:
    """Largest difference over the largest value."""
    value, reference = value.detach().double(), reference.detach().double()
    away = (value - reference.view_as(value)).abs().max()
    return float(away / reference.abs().max().clamp_min(1e-12))


def close(value: Tensor, reference: Tensor, tolerance: float, name: str = "") -> None:
    assert error(value, reference) <= tolerance, f"{name}: {error(value, reference):.1e}"


def step(function: Callable[[Tensor], Tensor], points: Tensor) -> tuple[Tensor, Tensor | None]:
    """Logits, and the gradient of the points for a sum with fixed weights."""
    points = points.clone().requires_grad_()
    logits = function(points)
    weights = torch.randn(logits.shape, generator=torch.Generator().manual_seed(2)).to(logits)
    (logits * weights).sum().backward()
    return logits.detach(), points.grad


def compare(
    name: str, model: Any, points: Tensor, tolerance: float = 1e-9, gradients: bool = True
) -> None:
    """Compare with the textbook form: logits, running statistics, and every gradient.

    Args:
        name: One of `NETWORKS`.
        model: It, in any mode and precision.
        points: Clouds of the same precision.
        tolerance: Of each tensor, over its largest value.
        gradients: Whether they have to agree; at ties they are shared in another way.
    """
    slow, forward = textbook_of(name, model, points)
    rounded = copy.deepcopy(slow).to(points.dtype)
    logits, of_points = step(model, points)
    expected, of_same_points = step(forward, points.double())
    close(logits, expected, tolerance, "logits")
    pairs = getattr(textbook(name.split()[0]), "pairs", lambda *both: [both])
    matched = [
        (key, one, two)
        for both in pairs(model, slow)
        for (key, one), two in zip(
            both[0].state_dict(keep_vars=True).items(), both[1].state_dict(keep_vars=True).values(),
            strict=True,
        )
    ]  # fmt: skip
    assert {id(p) for p in model.parameters()} == {id(p) for _, p, _ in matched if p.requires_grad}
    for key, one, two in matched:
        if not two.requires_grad:
            close(one.double(), two.double(), tolerance, key)
    if not gradients:
        return
    # 30 units from the origin a T-Net's matrix moves clouds apart by 30 times its own rounding:
    # there single precision misses 1e-4 in some gradients of the textbook form itself.
    errors: dict[int, Tensor] = {}
    single = points.dtype == torch.float32
    if single and getattr(model, "input_transform", None) and model.training and points.mean() > 9:
        _, of_rounded = step(rounded, points)
        errors = {
            id(p): q.grad for p, q in zip(slow.parameters(), rounded.parameters(), strict=True)
        } | {0: of_rounded}

    def allowed(place: int, reference: Tensor) -> float:
        return max(tolerance, 3 * error(errors[place], reference)) if place in errors else tolerance

    for key, one, two in matched:
        if two.requires_grad and two.grad.abs().max() > 1e-6:  # a bias before a normalisation: none
            close(one.grad, two.grad, allowed(id(two), two.grad), key)
    if of_same_points is not None and not name.startswith("simpleview"):
        close(of_points, of_same_points, allowed(0, of_same_points), "points")
