"""Point operations against their textbook forms, and their share of a PointNet++ training step.

Run: python benchmarks/point_ops.py [--threads 2] [--points 1024] [--batch 16] [--repeats 5]
The median of the repeats is printed; all take turns, so that they see the same load. Peak memory
is that of a training step in a process of its own.
"""

import argparse
import importlib.util
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType

import torch
from models import peak_memory
from torch import Tensor, nn

from qs3.models import PointNet2
from qs3.models.ops import ball_query, farthest_point_sampling, gather_points


def reference() -> ModuleType:
    spec = importlib.util.spec_from_file_location(
        "reference_pointnet2", Path(__file__).with_name("reference") / "pointnet2.py"
    )
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def step(model: nn.Module, points: Tensor, labels: Tensor) -> Callable[[], None]:
    def run() -> None:
        model.zero_grad()
        nn.functional.cross_entropy(model(points), labels).backward()

    return run


def medians(runs: dict[str, Callable[[], object]], repeats: int) -> dict[str, float]:
    seconds: dict[str, list[float]] = {name: [] for name in runs}
    for repeat in range(repeats + 1):  # the first one warms up
        for name, run in runs.items():
            start = time.perf_counter()
            run()
            if repeat:
                seconds[name].append(time.perf_counter() - start)
    return {name: 1e3 * statistics.median(values) for name, values in seconds.items()}


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--points", type=int, default=1024)
    parser.add_argument("--batch", type=int, default=16)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--grouping", choices=["ssg", "msg"], default="ssg")
    parser.add_argument("--memory-of", choices=["ours", "textbook"])
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    torch.manual_seed(0)
    book = reference()
    points = nn.functional.normalize(torch.randn(options.batch, options.points, 3), dim=2)
    labels = torch.randint(0, 10, (options.batch,))
    ours = PointNet2(10, grouping=options.grouping)
    theirs = book.from_ours(ours)
    if options.memory_of:
        run = step(ours if options.memory_of == "ours" else theirs, points, labels)
        before = peak_memory(reset=True)
        run()
        print((peak_memory() - before) // 2**20)
        return
    first = farthest_point_sampling(points, min(512, options.points))
    centres = gather_points(points, first)
    second = min(128, centres.shape[1])
    level = gather_points(centres, farthest_point_sampling(centres, second))
    balls = [(points, centres, 0.2, 32), (centres, level, 0.4, 64)]
    runs: dict[str, Callable[[], object]] = {
        "sampling, ours": lambda: [
            farthest_point_sampling(points, first.shape[1]),
            farthest_point_sampling(centres, second),
        ],
        "sampling, textbook": lambda: [
            book.sample(points, first.shape[1]),
            book.sample(centres, second),
        ],
        "balls, ours": lambda: [ball_query(*ball) for ball in balls],
        "balls, textbook": lambda: [book.ball(*ball, "nearest") for ball in balls],
        "step, ours": step(ours, points, labels),
        "step, textbook": step(theirs, points, labels),
    }
    found = medians(runs, options.repeats)
    print(
        f"PointNet++ ({options.grouping}), {options.batch} x {options.points} points, "
        f"{options.threads} threads, median of {options.repeats}"
    )
    for what in ("sampling", "balls", "step"):
        fast, slow = found[f"{what}, ours"], found[f"{what}, textbook"]
        print(f"{what:9} {fast:8.1f} ms, textbook {slow:8.1f} ms; ratio {slow / fast:.2f}")
    if options.grouping == "ssg":
        for what in ("sampling", "balls"):
            share = found[f"{what}, ours"] / found["step, ours"]
            print(f"share of {what} in a step of ours: {share:.1%}")
    for which in ("ours", "textbook"):
        command = [sys.executable, __file__, *sys.argv[1:], "--memory-of", which]
        peak = subprocess.run(command, capture_output=True, text=True, check=True).stdout.strip()
        print(f"peak memory of a step above the model, {which}: {peak} MB")


if __name__ == "__main__":
    main()
