"""The data factory: rate, scaling from one worker to two, and its overhead over bare scans.

    python benchmarks/generate.py --meshes ../shared/data/cad --objects 60 --repeats 3

Objects a second with one worker and with two (a worker has one thread), and with bare scans in one
process of one thread, in turns; medians. The start of the processes and their first scans, which
compile, are not counted; the factory's writing and syncing is.
"""

import argparse
import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from qs3.meshes import MeshItem, collect
from qs3.store.executors import LocalExecutor
from qs3.store.executors.local import ONE_THREAD
from qs3.store.generate import generate
from qs3.store.plan import resolve_renderer
from qs3.store.scan_item import GenerateSettings, scan_item


def bare(items: list[MeshItem], settings: GenerateSettings) -> float:
    """Seconds of scans alone, one after another."""
    scan_item(items[0], 0, settings)
    start = time.perf_counter()
    for item in items:
        scan_item(item, 0, settings)
    return time.perf_counter() - start


class Warm(LocalExecutor):
    """Processes that have scanned before the clock starts, and end after it has stopped."""

    def start(self, item: MeshItem, settings: GenerateSettings, scans: int) -> None:
        super().__enter__()
        for number in range(scans):
            self.submit(number, scan_item, item, 0, settings)
        for _ in range(scans):
            self.next()

    def __enter__(self) -> "Warm":
        return self

    def __exit__(self, *exception: object) -> None:
        return None


def factory(items: list[MeshItem], settings: GenerateSettings, workers: int) -> float:
    """Seconds of the factory, from the first scan to the last byte."""
    warm = Warm(workers)
    warm.start(items[0], settings, 6 * workers)
    with tempfile.TemporaryDirectory() as folder:
        start = time.perf_counter()
        generate(items, Path(folder) / "made", settings, executor=warm, progress=False)
        seconds = time.perf_counter() - start
    LocalExecutor.__exit__(warm, None, None, None)
    return seconds


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--meshes", required=True)
    parser.add_argument("--objects", type=int, default=60)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--bare", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    items = collect(options.meshes)
    items = items[:: max(len(items) // options.objects, 1)][: options.objects]
    settings = resolve_renderer(GenerateSettings(rows_per_shard=16))
    if options.bare:
        print(bare(items, settings))
        return
    seconds: dict[str, list[float]] = {"bare scan": [], "1 worker": [], "2 workers": []}
    command = [sys.executable, __file__, *sys.argv[1:], "--bare"]
    for _ in range(options.repeats):
        alone = subprocess.run(
            command, env=os.environ | ONE_THREAD, check=True, capture_output=True
        )
        seconds["bare scan"].append(float(alone.stdout))
        for workers, name in enumerate(("1 worker", "2 workers"), 1):
            seconds[name].append(factory(items, settings, workers))
    print(f"{len(items)} meshes, {options.repeats} rounds, load {os.getloadavg()[0]:.1f}\n")
    print("| | seconds (median) | all rounds | objects/s |\n|---|---|---|---|")
    for name, values in seconds.items():
        value, every = statistics.median(values), ", ".join(f"{one:.1f}" for one in values)
        print(f"| {name} | {value:.1f} | {every} | {len(items) / value:.2f} |")


if __name__ == "__main__":
    main()
