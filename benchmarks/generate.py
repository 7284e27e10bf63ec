"""The data factory: rate, scaling from one worker to two, and its overhead over bare scans.

    python benchmarks/generate.py --meshes ../shared/data/cad --objects 60 --repeats 3
    python benchmarks/generate.py --full generated --meshes ../shared/data/cad --shapes 2000

The first prints three figures, each measured beside the others in one run, rounds interleaved and
the median taken: objects a second with one worker and with two (a worker has one thread), and
with bare ``qs3.scan`` in one process of one thread. The start of the processes and their first
scan, which compiles, are not counted on either side; the factory's writing and syncing is.

The second makes one data set of all meshes and procedural shapes with two workers, and says how
long a set of the size of SpeckleNet10 (5,039 objects) takes at that rate.
"""

import argparse
import dataclasses
import os
import shutil
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from qs3.meshes import MeshItem, collect
from qs3.store.executors import Executor, LocalExecutor
from qs3.store.executors.local import ONE_THREAD
from qs3.store.failures import read_failures
from qs3.store.generate import generate
from qs3.store.info import info
from qs3.store.plan import resolve_renderer
from qs3.store.scan_item import GenerateSettings, scan_item

SPECKLENET10 = 5039
BARE = """
import sys
from benchmarks_generate import chosen, settings_of, bare
if __name__ == "__main__":
    print(bare(sys.argv[1], int(sys.argv[2])))
"""


def chosen(meshes: str, count: int) -> list[MeshItem]:
    """Meshes spread over the list, and as many procedural shapes where it is short of them."""
    items = collect(meshes)
    step = max(len(items) // count, 1)
    return items[::step][:count]


def settings_of() -> GenerateSettings:
    return resolve_renderer(GenerateSettings(rows_per_shard=16))


def bare(meshes: str, count: int) -> float:
    """Seconds of scans alone, one after another."""
    from qs3.sensor.scan import scan

    items, settings = chosen(meshes, count), settings_of()
    scan(items[0].load(), seed=0, renderer=settings.renderer)
    start = time.perf_counter()
    for item in items:
        scan_item(item, 0, settings)
    return time.perf_counter() - start


class Warm:
    """A pool that is started, and has scanned once in each process, before the clock is."""

    def __init__(self, workers: int, item: MeshItem, settings: GenerateSettings) -> None:
        self.pool = LocalExecutor(workers)
        self.pool.__enter__()
        for _ in range(3):
            for worker in range(2 * workers):
                self.pool.submit(worker, scan_item, item, 0, settings)
            for _ in range(2 * workers):
                self.pool.next()

    @property
    def ahead(self) -> int:
        return self.pool.ahead

    def submit(self, key, function, *arguments):
        self.pool.submit(key, function, *arguments)

    def next(self):
        return self.pool.next()

    def __enter__(self) -> Executor:
        return self.pool

    def __exit__(self, *exception: object) -> None:
        self.pool.__exit__(*exception)


def factory(items: list[MeshItem], workers: int, folder: Path) -> float:
    """Seconds of the factory, from the first scan to the last byte."""
    settings = settings_of()
    warm = Warm(workers, items[0], settings)
    out = folder / f"workers-{workers}"
    start = time.perf_counter()
    generate(items, out, settings, executor=warm, progress=False)
    seconds = time.perf_counter() - start
    shutil.rmtree(out)
    return seconds


def compare(options: argparse.Namespace) -> None:
    items = chosen(options.meshes, options.objects)
    seconds: dict[str, list[float]] = {"bare scan": [], "1 worker": [], "2 workers": []}
    with tempfile.TemporaryDirectory(dir=options.folder) as name:
        folder = Path(name)
        shutil.copy(__file__, folder / "benchmarks_generate.py")
        (folder / "bare.py").write_text(BARE)
        for turn in range(options.repeats):
            command = [sys.executable, "bare.py", str(Path(options.meshes).resolve())]
            command.append(str(options.objects))
            how = {"cwd": folder, "env": os.environ | ONE_THREAD, "check": True}
            found = subprocess.run(command, capture_output=True, text=True, **how)
            seconds["bare scan"].append(float(found.stdout))
            seconds["1 worker"].append(factory(items, 1, folder))
            seconds["2 workers"].append(factory(items, 2, folder))
            print(turn, {k: round(v[-1], 2) for k, v in seconds.items()}, file=sys.stderr)
    medians = {name: statistics.median(values) for name, values in seconds.items()}
    print(f"{len(items)} meshes, {options.repeats} rounds, load {os.getloadavg()[0]:.1f}\n")
    print("| | seconds (median) | all rounds | objects/s |\n|---|---|---|---|")
    for name, value in medians.items():
        every = ", ".join(f"{one:.1f}" for one in seconds[name])
        print(f"| {name} | {value:.1f} | {every} | {len(items) / value:.2f} |")
    overheads = [b / a - 1 for a, b in zip(seconds["bare scan"], seconds["1 worker"], strict=True)]
    gains = [b / a for a, b in zip(seconds["2 workers"], seconds["1 worker"], strict=True)]
    print(f"\noverhead of the factory: {statistics.median(overheads):+.1%} (goal ≤ 5 %)")
    print(f"two workers over one: {statistics.median(gains):.2f} × (goal ≥ 1.8)")


def full(options: argparse.Namespace) -> None:
    """Make one data set of the folder's meshes and of procedural shapes."""
    shapes = collect("shapes", per_class=options.shapes // 10)
    items = [*collect(options.meshes), *shapes]
    settings = dataclasses.replace(settings_of(), meshes="cad+shapes", rows_per_shard=64)
    start = time.perf_counter()
    report = generate(items, options.full, settings, workers=2)
    seconds = time.perf_counter() - start
    counts = info(options.full)
    print(f"{report}: {seconds:.0f} s, load {os.getloadavg()[0]:.1f}")
    print(f"{counts['rows']} rows, {counts['bytes'] / 1e6:.0f} MB, {counts['failed']} failed")
    for record in read_failures(options.full):
        print(f"  {record['id']}: {record['reason']}")
    if report.done:
        rate = (report.done + report.failed) / seconds
        print(f"{rate:.2f} objects/s; {SPECKLENET10} objects: {SPECKLENET10 / rate / 60:.0f} min")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--meshes", required=True)
    parser.add_argument("--objects", type=int, default=60)
    parser.add_argument("--repeats", type=int, default=3)
    parser.add_argument("--shapes", type=int, default=2000)
    parser.add_argument("--full", type=Path)
    parser.add_argument("--folder", type=Path)
    options = parser.parse_args()
    if options.full is None:
        compare(options)
    else:
        full(options)


if __name__ == "__main__":
    main()
