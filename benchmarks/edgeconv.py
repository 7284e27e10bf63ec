"""Factorised against textbook EdgeConv: a training step of DGCNN, and of its EdgeConvs alone.

Run: python benchmarks/edgeconv.py [--threads 2] [--points 1024] [--batch 8] [--repeats 5]
The median of the repeats is printed; the two forms take turns, so that both see the same load.
"""

import argparse
import statistics
import time
from collections.abc import Callable

import torch
from torch import Tensor, nn

from qs3.models import DGCNN
from qs3.models.dgcnn import EdgeConv
from qs3.models.ops import knn


class TextbookEdgeConv(nn.Module):
    """The explicit edge tensor, 1×1 convolution, BatchNorm2d, maximum over neighbours."""

    def __init__(self, fast: EdgeConv) -> None:
        super().__init__()
        width, twice = fast.linear.weight.shape
        self.convolution = nn.Conv2d(twice, width, 1, bias=False)
        self.norm = nn.BatchNorm2d(width)

    def forward(self, points: Tensor, neighbours: Tensor) -> Tensor:
        cloud = torch.arange(len(points), device=points.device)[:, None, None]
        around = points[cloud, neighbours]
        centre = points[:, :, None].expand_as(around)
        edges = torch.cat([around - centre, centre], dim=3).permute(0, 3, 1, 2)
        value = nn.functional.leaky_relu(self.norm(self.convolution(edges)), 0.2)
        return value.amax(dim=3).transpose(1, 2).contiguous()


def network_step(model: DGCNN, points: Tensor, labels: Tensor) -> Callable[[], None]:
    optimiser = torch.optim.Adam(model.parameters())

    def step() -> None:
        optimiser.zero_grad()
        nn.functional.cross_entropy(model(points), labels).backward()
        optimiser.step()

    return step


def layers_step(model: DGCNN, points: Tensor) -> Callable[[], None]:
    """The EdgeConvs alone, all on the neighbours of the input."""
    neighbours = knn(points, model.neighbours)

    def step() -> None:
        features = points
        for convolution in model.convolutions:
            features = convolution(features, neighbours)
        features.square().mean().backward()

    return step


def race(name: str, runners: dict[str, Callable[[], None]], repeats: int, batch: int) -> None:
    seconds: dict[str, list[float]] = {key: [] for key in runners}
    for repeat in range(repeats + 1):  # the first one warms up
        for key, runner in runners.items():
            start = time.perf_counter()
            runner()
            if repeat:
                seconds[key].append(time.perf_counter() - start)
    fast, slow = (statistics.median(values) * 1e3 / batch for values in seconds.values())
    print(f"{name}: {fast:.1f} ms a sample, textbook {slow:.1f}; ratio {slow / fast:.2f}")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--points", type=int, default=1024)
    parser.add_argument("--batch", type=int, default=8)
    parser.add_argument("--repeats", type=int, default=5)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    torch.manual_seed(0)
    points = torch.randn(options.batch, options.points, 3)
    labels = torch.randint(0, 10, (options.batch,))
    fast, slow = DGCNN(10), DGCNN(10)
    slow.convolutions = nn.ModuleList(
        TextbookEdgeConv(layer) for layer in fast.convolutions if isinstance(layer, EdgeConv)
    )
    print(
        f"{options.batch} x {options.points} points, {options.threads} threads, "
        f"median of {options.repeats}"
    )
    steps = {"fast": layers_step(fast, points), "textbook": layers_step(slow, points)}
    race("EdgeConvs, forward and backward", steps, options.repeats, options.batch)
    steps = {
        "fast": network_step(fast, points, labels),
        "textbook": network_step(slow, points, labels),
    }
    race("DGCNN, training step", steps, options.repeats, options.batch)


if __name__ == "__main__":
    main()
