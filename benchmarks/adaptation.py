"""Time and memory of one training step of each method, as a ratio to source-only.

    python benchmarks/adaptation.py --out adaptation.json [--network dgcnn] [--points 1024]
                                    [--batch 32] [--rounds 5] [--device cpu] [--threads 1]

- A step is losses, gradients and Adam on one batch of each domain. ``self-training`` is a step of
  the rounds (spst, qbst): pseudo-labelled clouds and as many of the source.
- Times are medians over rounds; in each round every method takes one step, so that a machine
  that grows slower slows all alike.
- Peak memory is that of a first step, Adam's state included, above what stood before it
  (weights), in a process of its own.
- ``chamfer``: forward and backward of DefRec's Chamfer distance at 32 × 4096 points, all of which
  count. The goal: within 1 GiB.

Writes JSON, and prints a Markdown table.
"""

import argparse
import dataclasses
import json
import resource
import statistics
import subprocess
import sys
import time
from pathlib import Path

import torch

from qs3.adaptation import PseudoLabelled, list_methods
from qs3.adaptation.defrec import chamfer
from qs3.adaptation.method import Batch
from qs3.evaluation import hardware, versions
from qs3.files import write_json
from qs3.training import TrainSettings
from qs3.training.trainer import fresh_model, make_method

ROUNDS = "self-training"
GOAL = 2**30
CHAMFER_CLOUDS, CHAMFER_POINTS = 32, 4096


class Step:
    """One optimiser step of a method without rounds on random clouds, to be timed."""

    def __init__(self, method: str, settings: TrainSettings, device: torch.device) -> None:
        classes = 10
        model = fresh_model(method, settings, classes)
        self.method = make_method(method, model, settings).to(device).train()
        self.generator = torch.Generator().manual_seed(0)
        size = (settings.batch_size, settings.num_points, 3)
        points = torch.rand(2, *size, generator=self.generator).sub_(0.5).to(device)
        labels = torch.arange(settings.batch_size, device=device) % classes
        self.source = Batch(points[0], labels)
        self.target = points[1] if self.method.uses_target else None
        self.optimiser = torch.optim.Adam(self.method.parameter_groups(1e-3))
        self.device = device

    def __call__(self) -> float:
        """Take the step and return its seconds."""
        self._wait()
        start = time.perf_counter()
        losses = self.method(self.source, self.target, 0.5, self.generator)
        self.optimiser.zero_grad()
        torch.stack(list(losses.values())).sum().backward()
        self.optimiser.step()
        self.method.after_step()
        self._wait()
        return time.perf_counter() - start

    def _wait(self) -> None:
        if self.device.type == "cuda":
            torch.cuda.synchronize(self.device)


def make_step(name: str, settings: TrainSettings, device: torch.device) -> Step:
    if name != ROUNDS:
        return Step(name, settings, device)
    step = Step("source-only", settings, device)
    points, labels = step.source.points, step.source.labels
    count = len(labels)
    step.method = PseudoLabelled(step.method.model).to(device).train()
    step.source = Batch(
        torch.cat([points, points.flip(0)]), torch.cat([labels, labels.flip(0)]), (count, count)
    )
    step.optimiser = torch.optim.Adam(step.method.parameter_groups(1e-3))
    return step


def peak(device: torch.device) -> int:
    """Most bytes held so far: of the GPU's allocator, or resident in this process."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device)
    status = Path("/proc/self/status")
    if status.is_file():  # ru_maxrss of a child begins at its parent's
        line = next(x for x in status.read_text().splitlines() if x.startswith("VmHWM"))
        return int(line.split()[1]) * 1024
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024


def begin(device: torch.device) -> int:
    """Bytes held now; the peak begins anew from here."""
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
        return torch.cuda.memory_allocated(device)
    clear = Path("/proc/self/clear_refs")
    if clear.exists():
        clear.write_text("5")
    return peak(device)


def measure_memory(name: str, settings: TrainSettings, device: torch.device) -> dict[str, float]:
    """Peak bytes of one step or of the Chamfer distance, and the latter's seconds."""
    if name != "chamfer":
        few = dataclasses.replace(settings, num_points=64, batch_size=4)
        make_step(name, few, device)()  # brings up the libraries
        step = make_step(name, settings, device)
        before = begin(device)
        return {"seconds": step(), "bytes": peak(device) - before}
    generator = torch.Generator().manual_seed(0)
    x, y = torch.rand(2, CHAMFER_CLOUDS, CHAMFER_POINTS, 3, generator=generator).to(device)
    x.requires_grad_(True)
    chamfer(x[:1, :64], y[:1, :64]).sum().backward()  # libraries load
    x.grad = None
    before, start = begin(device), time.perf_counter()
    value = chamfer(x, y).mean()
    value.backward()
    float(value.detach())
    return {"seconds": time.perf_counter() - start, "bytes": peak(device) - before}


def in_own_process(name: str, options: argparse.Namespace) -> dict[str, float]:
    given = ["--network", options.network, "--points", str(options.points)]
    given += ["--batch", str(options.batch), "--device", options.device, "--one", name]
    given += ["--threads", str(options.threads)]
    done = subprocess.run(
        [sys.executable, __file__, *given], stdout=subprocess.PIPE, text=True, check=True
    )
    return json.loads(done.stdout.splitlines()[-1])


def measure_times(
    names: list[str], settings: TrainSettings, device: torch.device, rounds: int
) -> dict[str, list[float]]:
    steps = {name: make_step(name, settings, device) for name in names}
    for step in steps.values():
        step()
    times: dict[str, list[float]] = {name: [] for name in names}
    for _ in range(rounds):
        for name, step in steps.items():
            times[name].append(step())
    return times


def markdown(result: dict) -> str:
    rows = result["methods"]
    base = rows["source-only"]
    lines = ["| step of | ms | × source-only | peak MiB | × source-only |", "|---|---|---|---|---|"]
    for name, row in rows.items():
        ms, mib = row["seconds"] * 1e3, row["bytes"] / 2**20
        ratios = row["seconds"] / base["seconds"], row["bytes"] / max(base["bytes"], 1)
        lines.append(f"| {name} | {ms:.0f} | {ratios[0]:.2f} | {mib:.0f} | {ratios[1]:.2f} |")
    one = result["chamfer"]
    good = "within" if one["bytes"] <= GOAL else "NOT within"
    lines += [
        "",
        f"DefRec's Chamfer distance, forward and backward, {CHAMFER_CLOUDS} × {CHAMFER_POINTS} "
        f"points: {one['seconds']:.2f} s, peak {one['bytes'] / 2**20:.0f} MiB, {good} 1 GiB.",
    ]
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--out", type=Path, default=Path("adaptation.json"))
    parser.add_argument("--network", default="dgcnn")
    parser.add_argument("--points", type=int, default=1024)
    parser.add_argument("--batch", type=int, default=32)
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--methods", nargs="+", default=[*list_methods(), ROUNDS])
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--one", help=argparse.SUPPRESS)
    options = parser.parse_args()
    torch.set_num_threads(options.threads)
    device = torch.device(options.device)
    settings = TrainSettings(
        model=options.network, num_points=options.points, batch_size=options.batch
    )
    if options.one:
        print(json.dumps(measure_memory(options.one, settings, device)))
        return
    names = list(dict.fromkeys(["source-only", *options.methods]))
    times = measure_times(names, settings, device, options.rounds)
    rows = {
        name: {
            "seconds": statistics.median(times[name]),
            "all": times[name],
            "bytes": in_own_process(name, options)["bytes"],
        }
        for name in names
    }
    result = {
        "network": options.network,
        "points": options.points,
        "batch": options.batch,
        "device": options.device,
        "threads": options.threads,
        "methods": rows,
        "chamfer": in_own_process("chamfer", options),
        "versions": versions(),
        "hardware": hardware(),
    }
    write_json(options.out, result)
    options.out.with_suffix(".md").write_text(markdown(result) + "\n", encoding="utf-8")
    print(markdown(result))


if __name__ == "__main__":
    main()
