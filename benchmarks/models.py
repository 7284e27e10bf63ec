"""Time and memory of the networks against their textbook forms in benchmarks/reference/.

Run:  python benchmarks/models.py                     the table, on the GPU where there is one
      python benchmarks/models.py --networks dgcnn --precisions fp32 --threads 2
      python benchmarks/models.py --points 256 512 1024 2048 4096 8192    a plot of the cost

A Markdown table goes to standard output, everything to a JSON file. How it is measured:

- Both forms hold the same weights and see the same clouds. They take turns, so that both see the
  same load; printed are the median over the rounds and, in brackets, the smallest and the largest.
- "forward" is evaluation without gradients; "step" is a training step: forward, cross-entropy,
  backward, Adam.
- Peak memory is that of one forward or step, above what stood before it (weights, Adam's state,
  the clouds, the libraries), in a process of its own. On a CPU it is the high-water mark of the
  resident set, which misses nothing: buffers of the matrix library and what the allocator holds
  back are counted. On a GPU it is what PyTorch has allocated.
"""

import argparse
import importlib
import json
import platform
import resource
import statistics
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import Tensor, nn

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


def race(runs: dict[str, Callable[[], None]], rounds: int, limit: float) -> dict[str, list[float]]:
    """Seconds of each, taking turns; after the limit only until there are three rounds."""
    seconds: dict[str, list[float]] = {key: [] for key in runs}
    for run in runs.values():  # warms up
        run()
    start = time.perf_counter()
    for done in range(rounds):
        if done >= 3 and time.perf_counter() - start > limit:
            break
        for key, run in runs.items():
            seconds[key].append(seconds_of(run))
    return seconds


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
    return {
        "bytes": after - before,
        "seconds": [seconds_of(run) for _ in range(job["rounds"])],
    }


def apart(job: dict[str, Any]) -> dict[str, Any] | None:
    """`one` in a process of its own; None where it runs out of memory."""
    command = [sys.executable, str(Path(__file__).resolve()), "--one", json.dumps(job)]
    done = subprocess.run(command, capture_output=True, text=True)
    if done.returncode:
        print(f"{job}: {done.stderr.strip().splitlines()[-1:]}", file=sys.stderr)
        return None
    return json.loads(done.stdout.splitlines()[-1])


def job_of(options: argparse.Namespace, **given: Any) -> dict[str, Any]:
    names = ("batch", "threads", "device", "limit_gib")
    return {name: getattr(options, name) for name in names} | {"rounds": 0} | given


def compare(options: argparse.Namespace) -> list[dict[str, Any]]:
    rows = []
    print(f"| {' | '.join(COLUMNS)} |\n|{'---|' * len(COLUMNS)}", flush=True)
    n = options.points[0]
    points, labels = clouds(options.batch, n, options.device)
    for network in options.networks:
        for precision in options.precisions:
            for mode in options.modes:
                row: dict[str, Any] = {"network": network, "precision": precision, "mode": mode}
                runs = {
                    form: runner(
                        make(network, form, options.device), mode, points, labels, precision
                    )
                    for form in FORMS
                }
                row["seconds"] = race(runs, options.rounds, options.seconds)
                del runs
                row["memory"] = {
                    form: apart(
                        job_of(
                            options,
                            network=network,
                            form=form,
                            mode=mode,
                            precision=precision,
                            points=n,
                        )
                    )
                    for form in FORMS
                }
                rows.append(row)
                print(line(row, options.batch), flush=True)
    return rows


COLUMNS = ("network", "what", "ms a sample, ours", "textbook", "ratio", "samples/s, ours")
COLUMNS += ("peak MiB, ours", "textbook", "ratio")


def line(row: dict[str, Any], batch: int) -> str:
    def span(values: list[float]) -> str:
        low, middle, high = (
            f"{1e3 * value / batch:.3g}"
            for value in (min(values), statistics.median(values), max(values))
        )
        return f"{middle} ({low}–{high})"

    ours, textbook = (row["seconds"][form] for form in FORMS)
    ratio = statistics.median(textbook) / statistics.median(ours)
    memory = [row["memory"][form] and row["memory"][form]["bytes"] / 2**20 for form in FORMS]
    told = ["–" if value is None else f"{value:.0f}" for value in memory]
    saving = f"{memory[1] / max(memory[0], 1e-9):.1f}" if None not in memory else "–"
    cells = [
        row["network"],
        f"{row['mode']}, {row['precision']}",
        span(ours),
        span(textbook),
        f"{ratio:.1f}",
        f"{batch / statistics.median(ours):.0f}",
        *told,
        saving,
    ]
    return f"| {' | '.join(cells)} |"


def against_points(options: argparse.Namespace) -> list[dict[str, Any]]:
    rows = []
    for network in options.networks:
        for form in FORMS:
            for n in sorted(options.points):
                job = job_of(
                    options,
                    network=network,
                    form=form,
                    mode=options.modes[-1],
                    precision=options.precisions[0],
                    points=n,
                )
                found = apart(job | {"rounds": min(3, options.rounds)})
                if found is None or found["bytes"] > options.limit_gib * 2**30:
                    print(f"{network}, {form}: {n} points need over {options.limit_gib} GiB")
                    break
                rows.append(job | found)
                cost = 1e3 * statistics.median(found["seconds"]) / options.batch
                mebibytes = found["bytes"] / 2**20
                print(f"{network}, {form}, {n} points: {cost:.3g} ms a sample, {mebibytes:.0f} MiB")
    return rows


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
            cost = [1e3 * statistics.median(row["seconds"]) / batch for row in here]
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


def machine(options: argparse.Namespace) -> dict[str, Any]:
    model = [
        text.split(":")[1].strip()
        for text in Path("/proc/cpuinfo").read_text().splitlines()
        if text.startswith("model name")
    ] if Path("/proc/cpuinfo").is_file() else [platform.processor()]  # fmt: skip
    return {
        "torch": torch.__version__,
        "device": torch.cuda.get_device_name() if options.device == "cuda" else model[0],
        "capability": torch.backends.cpu.get_cpu_capability(),
    }


def main() -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    known = [name for name in list_models() if reference_file(name).is_file()]
    parser.add_argument("--networks", nargs="+", default=known, choices=known)
    parser.add_argument("--precisions", nargs="+", default=["fp32", "bf16"])
    parser.add_argument("--modes", nargs="+", default=list(MODES), choices=MODES)
    parser.add_argument("--points", nargs="+", type=int, default=[1024])
    parser.add_argument("--batch", type=int, help="16; 4 for several numbers of points")
    parser.add_argument("--rounds", type=int, default=7)
    parser.add_argument("--seconds", type=float, default=120, help="of one race, above 3 rounds")
    parser.add_argument("--threads", type=int, default=torch.get_num_threads())
    parser.add_argument("--device", default="cuda" if torch.cuda.is_available() else "cpu")
    parser.add_argument("--limit-gib", type=float, default=8, help="memory at which a curve ends")
    parser.add_argument("--json", type=Path, default=Path("models.json"))
    parser.add_argument("--plot", type=Path, default=Path("models.png"))
    parser.add_argument("--one", type=json.loads, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.one:
        print(json.dumps(one(options.one)))
        return
    several = len(options.points) > 1
    options.batch = options.batch or (4 if several else 16)
    torch.set_num_threads(options.threads)
    facts = machine(options)
    told = ", ".join(str(value) for value in facts.values())
    print(
        f"{options.batch} x {options.points} points, {options.threads} threads; {told}\n",
        flush=True,
    )
    rows = against_points(options) if several else compare(options)
    settings = {k: v for k, v in vars(options).items() if k not in ("one", "json", "plot")}
    options.json.write_text(json.dumps({"machine": facts, "settings": settings, "rows": rows}))
    if several and rows:
        plot(rows, options.plot)


if __name__ == "__main__":
    main()
