"""Time and memory of the networks against their textbook forms in benchmarks/reference/.

Run:  python benchmarks/models.py                     the table, on the GPU where there is one
      python benchmarks/models.py --networks dgcnn --precisions fp32 --threads 2
      python benchmarks/models.py --points 256 512 1024 2048 4096 8192 --plot models.png

A Markdown table goes to standard output, everything to a JSON file. How it is measured:

- Both forms hold the same weights and see the same clouds. They take turns, each time in a process
  of its own, so that both see the same load; printed are medians over the rounds.
- "forward" is evaluation without gradients; "step" is a training step: forward, cross-entropy,
  backward, Adam.
- Peak memory is that of one forward or step, above what stood before it (weights, Adam's state,
  the clouds, the libraries). On a CPU it is the high-water mark of the
  resident set, which misses nothing: buffers of the matrix library and what the allocator holds
  back are counted. On a GPU it is what PyTorch has allocated.
"""

import argparse
import importlib
import itertools
import json
import platform
import resource
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from qs3.evaluation import hardware, versions
from qs3.models import create_model, list_models

HERE = Path(__file__).parent
CLASSES = 40
FORMS = ("ours", "textbook")
MODES = ("forward", "step")


def reference_file(name: str) -> Path:
    """The textbook form of a network."""
    return HERE / "reference" / f"{name.replace('-', '_')}.py"


def make(name: str, form: str, device: str) -> nn.Module:
    torch.manual_seed(0)
    ours = create_model(name, CLASSES).to(device)
    if form == "ours":
        return ours
    return importlib.import_module(f"reference.{reference_file(name).stem}").from_ours(ours)


def clouds(batch: int, n: int, device: str) -> tuple[Tensor, Tensor]:
    """Points on boxes of random sides in the unit ball: surfaces, as the networks see them."""
    generator = torch.Generator().manual_seed(0)
    points = torch.rand(batch, n, 3, generator=generator) * 2 - 1
    face = torch.randint(0, 3, (batch, n, 1), generator=generator)
    points.scatter_(2, face, points.gather(2, face).sign())
    points *= torch.rand(batch, 1, 3, generator=generator) * 0.8 + 0.2
    points /= points.norm(dim=2).amax(dim=1)[:, None, None]
    labels = torch.randint(0, CLASSES, (batch,), generator=generator)
    return points.to(device), labels.to(device)


def runner(
    model: nn.Module, mode: str, points: Tensor, labels: Tensor, precision: str
) -> Callable[..., None]:
    """One forward or one training step, as a function that returns when it is done."""
    device = points.device.type
    model.train(mode == "step")
    optimiser = torch.optim.Adam(model.parameters())

    def logits(points: Tensor) -> Tensor:
        with torch.autocast(device, torch.bfloat16, enabled=precision == "bf16"):
            return model(points)

    def run(points: Tensor = points, labels: Tensor = labels) -> None:
        if mode == "forward":
            with torch.no_grad():
                logits(points)
        else:
            optimiser.zero_grad()
            nn.functional.cross_entropy(logits(points).float(), labels).backward()
            optimiser.step()
        if device == "cuda":
            torch.cuda.synchronize()

    return run


def seconds_of(run: Callable[[], None]) -> float:
    start = time.perf_counter()
    run()
    return time.perf_counter() - start


def peak_memory(reset: bool = False) -> int:
    """High-water mark of the resident set in bytes, or the resident set itself after a reset.

    Linux hands a process the mark of the one that started it, which `getrusage` then tells; the
    kernel's own table can be set back.
    """
    status = Path("/proc/self/status")
    if status.is_file():
        if reset:
            Path("/proc/self/clear_refs").write_text("5")
        found = next(t for t in status.read_text().splitlines() if t.startswith("VmHWM"))
        return int(found.split()[1]) * 1024
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    return peak if platform.system() == "Darwin" else peak * 1024


def one(job: dict[str, Any]) -> dict[str, Any]:
    """Peak memory of one run and, over some rounds, its seconds; in a process of its own."""
    torch.set_num_threads(job["threads"])
    cuda = job["device"] == "cuda"
    if not cuda and job["limit_gib"]:
        # Allocations beyond fail in this process, before the machine runs out.
        bound = int((job["limit_gib"] + 2) * 2**30)
        resource.setrlimit(resource.RLIMIT_DATA, (bound, bound))
    model = make(job["network"], job["form"], job["device"])
    points, labels = clouds(job["batch"], job["points"], job["device"])
    run = runner(model, job["mode"], points, labels, job["precision"])
    # Few points bring up the libraries, the gradients and Adam's state.
    run(points[:2, :32].contiguous(), labels[:2])
    if cuda:
        torch.cuda.reset_peak_memory_stats()
    before = torch.cuda.memory_allocated() if cuda else peak_memory(reset=True)
    run()
    after = torch.cuda.max_memory_allocated() if cuda else peak_memory()
    return {"bytes": after - before, "seconds": seconds_of(run)}


def apart(job: dict[str, Any]) -> dict[str, Any] | None:
    """`one` in a process of its own; None where it runs out of memory."""
    command = [sys.executable, str(Path(__file__).resolve()), "--one", json.dumps(job)]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        print(f"{job}: {done.stderr.strip().splitlines()[-1:]}", file=sys.stderr)
        return None
    return json.loads(done.stdout.splitlines()[-1])


def measure(options: argparse.Namespace) -> list[dict[str, Any]]:
    """Return a row for each network, precision, mode, form and number of points."""
    fixed = {name: getattr(options, name) for name in ("batch", "threads", "device", "limit_gib")}
    rows: list[dict[str, Any]] = []
    ended: set[tuple[str, ...]] = set()
    cells = itertools.product(
        options.networks, options.precisions, options.modes, sorted(options.points)
    )
    for network, precision, mode, points in cells:
        what = {"network": network, "precision": precision, "mode": mode, "points": points}
        measured: dict[str, list[dict[str, Any] | None]] = {form: [] for form in FORMS}
        for _, form in itertools.product(range(options.rounds), FORMS):
            if (*list(what.values())[:3], form) not in ended:
                measured[form].append(apart(fixed | what | {"form": form}))
                if measured[form][-1] is None:  # more points need more memory
                    ended.add((network, precision, mode, form))
        for form, results in measured.items():
            whole = [one for one in results if one is not None]
            if len(whole) == options.rounds:
                seconds, held = ([one[key] for one in whole] for key in ("seconds", "bytes"))
                row = fixed | what | {"form": form, "seconds": seconds, "bytes": max(held)}
                rows.append(row)
        print(line(what, [row for row in rows if what.items() <= row.items()]), flush=True)
    return rows


COLUMNS = ("network", "what", "points", "ms a sample, ours", "textbook", "ratio")
COLUMNS += ("peak MiB, ours", "textbook", "ratio")


def line(what: dict[str, Any], rows: list[dict[str, Any]]) -> str:
    cells = [what["network"], f"{what['mode']}, {what['precision']}", str(what["points"])]
    by_form = {row["form"]: row for row in rows}
    for key, factor in (("seconds", 1e3 / (rows[0]["batch"] if rows else 1)), ("bytes", 2**-20)):
        values = [
            factor * float(np.median(by_form[f][key])) if f in by_form else None for f in FORMS
        ]
        cells += ["–" if value is None else f"{value:.3g}" for value in values]
        ours, textbook = values
        cells.append("–" if not ours or not textbook else f"{textbook / ours:.1f}")
    return f"| {' | '.join(cells)} |"


def plot(rows: list[dict[str, Any]], path: Path) -> None:
    import matplotlib

    matplotlib.use("Agg")
    import matplotlib.pyplot as plt

    figure, (time_axis, memory_axis) = plt.subplots(1, 2, figsize=(11, 4.5), layout="constrained")
    batch = rows[0]["batch"]
    for number, network in enumerate(dict.fromkeys(row["network"] for row in rows)):
        for form, style in zip(FORMS, ("-", "--"), strict=True):
            here = [row for row in rows if (row["network"], row["form"]) == (network, form)]
            n = [row["points"] for row in here]
            cost = [1e3 * float(np.median(row["seconds"])) / batch for row in here]
            label = network if form == "ours" else None
            look = {"color": f"C{number}", "marker": "o", "markersize": 4, "linestyle": style}
            time_axis.plot(n, cost, label=label, **look)
            memory_axis.plot(n, [row["bytes"] / 2**20 / batch for row in here], **look)
    ticks = sorted({row["points"] for row in rows})
    for axis, what in ((time_axis, "ms a sample"), (memory_axis, "peak MiB a sample")):
        axis.set(xscale="log", yscale="log", xlabel="points", ylabel=what)
        axis.set_xticks(ticks, [str(n) for n in ticks])
        axis.minorticks_off()
        axis.grid(alpha=0.3)
    time_axis.legend(title="solid: ours, dashed: textbook", fontsize=8)
    mode = "training step" if rows[0]["mode"] == "step" else "forward"
    figure.suptitle(f"{mode}, batch {batch}, {rows[0]['precision']}, {rows[0]['device']}")
    figure.savefig(path, dpi=150)
    print(path)


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    known = [name for name in list_models() if reference_file(name).is_file()]
    parser.add_argument("--networks", nargs="+", default=known, choices=known)
    parser.add_argument("--precisions", nargs="+", default=["fp32", "bf16"])
    parser.add_argument("--modes", nargs="+", default=list(MODES), choices=MODES)
    parser.add_argument("--points", nargs="+", type=int, default=[1024])
    parser.add_argument("--batch", type=int, default=16)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--limit-gib", type=float, default=8, help="memory at which a curve ends")
    parser.add_argument("--json", type=Path, default=Path("models.json"))
    parser.add_argument("--plot", type=Path, help="of the cost over --points")
    parser.add_argument("--one", type=json.loads, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one:
        print(json.dumps(one(options.one)))
        return
    print(f"| {' | '.join(COLUMNS)} |\n|{'---|' * len(COLUMNS)}", flush=True)
    rows = measure(options)
    settings = {k: v for k, v in vars(options).items() if k not in ("one", "json", "plot")}
    machine = {**hardware(), **versions()}
    options.json.write_text(json.dumps({"machine": machine, "settings": settings, "rows": rows}))
    if options.plot:
        plot(rows, options.plot)


if __name__ == "__main__":
    main()
