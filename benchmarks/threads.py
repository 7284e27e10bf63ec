"""Samples a second of a training step beside busy programs, with OpenMP's threads as they spin.

    python benchmarks/threads.py --out threads.json

Each network is timed alone, beside one program that keeps a core busy and beside two; with
OpenMP's own spinning (*before*) and with the brief one that qs3 sets (`GOMP_SPINCOUNT`, *after*),
on all cores and on one thread; and `--threads auto` tells which number it would take. Give the
machine nothing else to do meanwhile.
"""

import argparse
import contextlib
import json
import os
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

CASES = ("dgcnn:8:256", "dgcnn:16:1024", "pointnet:32:1024", "pointnet2:16:512")
"""Network, clouds in a batch, points a cloud: a quick trial, and what people train."""
HEAD = (
    "| network | clouds × points | beside | before, all cores | after, all cores "
    "| after, one thread | auto takes |\n|---|---|---|---|---|---|---|"
)


@contextlib.contextmanager
def hogs(count: int) -> Iterator[None]:
    """Keep so many cores busy for a while."""
    command = [sys.executable, "-c", "while True: pass"]
    busy = [subprocess.Popen(command) for _ in range(count)]
    try:
        yield
    finally:
        for process in busy:
            process.kill()
            process.wait()


def measure(case: str, seconds: float) -> list[dict[str, Any]]:
    """Time a network here, in a process whose environment says how threads spin."""
    spin = os.environ.get("GOMP_SPINCOUNT")
    import torch  # before qs3, which would set how threads spin

    from qs3.adaptation import create_method
    from qs3.models import create_model
    from qs3.training import TrainSettings
    from qs3.training.distributed import make_fabric
    from qs3.training.threads import fastest, threads, trial_step

    name, batch, points = case.split(":")
    settings = TrainSettings(
        model=name, batch_size=int(batch), num_points=int(points), accelerator="cpu"
    )
    method = create_method("source-only", create_model(name, 10))
    step = trial_step(method, 10, settings, make_fabric(settings))
    most = torch.get_num_threads()
    lines = []
    for count in range(3):
        with hogs(count):
            line: dict[str, Any] = {"case": case, "hogs": count, "cores": most}
            for number in dict.fromkeys((most, 1)):
                with threads(number):
                    step()
                    start, steps = time.perf_counter(), 0
                    while steps < 2 or time.perf_counter() - start < seconds:
                        step()
                        steps += 1
                    rate = steps * settings.batch_size / (time.perf_counter() - start)
                line["one" if number == 1 else "all"] = rate
            if spin is not None:
                line["auto"] = fastest(step, most)
            lines.append(line)
    return lines


def measure_apart(case: str, seconds: float, spin: str | None) -> list[dict[str, Any]]:
    """Call `measure` in a process of its own."""
    environment = {name: v for name, v in os.environ.items() if name != "GOMP_SPINCOUNT"}
    environment |= {} if spin is None else {"GOMP_SPINCOUNT": spin}
    command = [sys.executable, __file__, "--case", case, "--seconds", str(seconds)]
    done = subprocess.run(command, env=environment, stdout=subprocess.PIPE, check=True)
    return json.loads(done.stdout)


def row(line: dict[str, Any]) -> str:
    """Return a row of the table, in samples a second."""
    name, batch, points = line["case"].split(":")
    beside = ("nothing", "one busy core", "two busy cores")[line["hogs"]]
    rates = (line["before"], line.get("all", line["one"]), line["one"])
    cells = (name, f"{batch} × {points}", beside, *(f"{rate:.3g}" for rate in rates))
    return f"| {' | '.join(cells)} | {line['auto']} of {line['cores']} |"


def main() -> None:
    """Measure all cases, print the table and write the numbers."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--cases", nargs="*", default=CASES, help="network:clouds:points")
    parser.add_argument("--seconds", type=float, default=3.0, help="for each rate")
    parser.add_argument("--out", type=Path, help="JSON file for the numbers")
    parser.add_argument("--case", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.case:
        print(json.dumps(measure(options.case, options.seconds)))
        return
    lines: list[dict[str, Any]] = []
    print(HEAD, flush=True)
    for case in options.cases:
        before = measure_apart(case, options.seconds, None)
        after = measure_apart(case, options.seconds, "1000")
        for old, new in zip(before, after, strict=True):
            lines.append(new | {"before": old.get("all", old["one"])})
            print(row(lines[-1]), flush=True)
    if options.out is not None:
        options.out.write_text(json.dumps(lines, indent=2) + "\n")


if __name__ == "__main__":
    main()
