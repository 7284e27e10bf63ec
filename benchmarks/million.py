"""What a million objects take: memory and processor time of planning, merging, checking, reading.

    python benchmarks/million.py --rows 25000 50000 100000

Data sets of synthetic rows (clouds of 16 points; every object a mesh file of its own name) are
written in two parts, and each stage runs in a process of its own: memory is the most that it held
beyond what it had after its imports; seconds are the processor's, which no busy machine changes.
Stages:

- plan: `generate` up to the first scan: checks of the list, checksums of the meshes, the manifest;
- resume: `generate` over the whole set, where all is there;
- merge, verify, info: as the verbs do it;
- stream: one epoch of random batches, shards in random order and one at a time;
- hold: what `qs3 train` reads today, all clouds at once.

The last lines are the growth from the smallest set to the largest, per row, and what a million
rows would take; a cloud of 2,048 points, as real ones have, counts in shards alone (`hold` apart).
"""

import argparse
import contextlib
import json
import subprocess
import sys
import tempfile
import time
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

POINTS, PARTS = 16, 2
STAGES = ("plan", "resume", "merge", "verify", "info", "stream", "hold")


@dataclass(frozen=True, slots=True)
class Item:
    """A mesh of the list; all share one small file."""

    id: str
    class_name: str
    path: Path
    split: str = "train"

    def load(self) -> Any:
        raise AssertionError("never scanned")


def settings() -> Any:
    from qs3.store.scan_item import GenerateSettings

    return GenerateSettings(num_points=POINTS)


def work_list(folder: Path, rows: int) -> list[Item]:
    from qs3.meshes.classes import POINTDA10

    mesh = folder / "mesh.off"
    return [
        Item(f"{POINTDA10[i % 10]}/object-{i:07d}", POINTDA10[i % 10], mesh) for i in range(rows)
    ]


def make(folder: Path, rows: int) -> None:
    """Write the parts as `generate --shard` does, row by row but without scans."""
    from qs3.store.folder import open_folder
    from qs3.store.manifest import Sums, mesh_sums, shard_name, write_manifest, write_mesh_sums
    from qs3.store.plan import make_plan
    from qs3.store.scan_item import scan_seed
    from qs3.store.shards import CloudRow, put_shard, table_of

    (folder / "mesh.off").write_text("OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n")
    plan = make_plan(work_list(folder, rows), settings())
    rng, view = np.random.default_rng(0), np.zeros(POINTS, np.uint8)
    for part in range(PARTS):
        target = open_folder(folder / f"part{part}")
        with target.claimed("dataset.json"):
            write_manifest(target, plan.manifest())
            write_mesh_sums(target, mesh_sums(plan.items_of(range(part, plan.shards, PARTS))))
            checksums = Sums(target)
            for shard in range(part, plan.shards, PARTS):
                table = []
                for place in plan.places(shard):
                    position, scan = plan.position(place)
                    item = plan.items[position]
                    points = rng.random((POINTS, 3), np.float32)
                    table.append(
                        CloudRow(
                            plan.row_id(place), item.id, scan, position % 10, item.class_name,
                            item.split, scan_seed(0, item.id, scan), points, view, points, view,
                            points,
                        )
                    )  # fmt: skip
                checksums.note(shard_name(shard), put_shard(target, shard, table_of(table)))
            checksums.write()


class Stop:
    """An executor that is handed the first scan, and stops."""

    ahead = 1

    def submit(self, *_: Any) -> None:
        raise KeyboardInterrupt

    def drain(self) -> None:
        pass

    def __enter__(self) -> "Stop":
        return self

    def __exit__(self, *_: object) -> None:
        pass


def stage(name: str, folder: Path, rows: int) -> dict[str, float]:
    """Run one stage in this process: its seconds, and MiB beyond those of the imports."""
    from qs3.io import load_clouds
    from qs3.store.folder import open_folder
    from qs3.store.generate import generate
    from qs3.store.info import info
    from qs3.store.manifest import finished_shards, open_dataset
    from qs3.store.merge import merge
    from qs3.store.shards import flat_clouds, load_shard
    from qs3.store.verify import verify

    whole, how = folder / "whole", {"executor": Stop(), "scan_one": print, "progress": False}
    Path("/proc/self/clear_refs").write_text("5")  # the most that was held begins anew
    before, start = held(), time.process_time()
    if name == "plan":
        with contextlib.suppress(KeyboardInterrupt):
            generate(work_list(folder, rows), folder / "new", settings(), **how)
    elif name == "resume":
        report = generate(work_list(folder, rows), whole, settings(), **how)
        assert report.skipped == rows
    elif name == "merge":
        merge([folder / f"part{part}" for part in range(PARTS)], whole, progress=False)
    elif name == "verify":
        assert verify(whole, progress=False) == []
    elif name == "info":
        assert info(whole)["rows"] == rows
    elif name == "stream":
        rng, count, store = np.random.default_rng(0), 0, open_folder(whole)
        shards = finished_shards(store, open_dataset(store).shards)
        for shard in rng.permutation(shards):
            table = load_shard(store, int(shard), ["id", "label", "points"])
            clouds = np.stack(flat_clouds(table, "points", whole))
            count += len(clouds[rng.permutation(len(clouds))])
        assert count == rows
    else:
        assert len(load_clouds(whole, num_points=None).points) == rows
    seconds = time.process_time() - start
    return {"seconds": seconds, "mebibytes": (held() - before) / 1024}


def held() -> int:
    """The most KiB that this process held since that was last forgotten; Linux alone tells."""
    status = Path("/proc/self/status").read_text()
    return int(status.split("VmHWM:")[1].split()[0])


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--rows", type=int, nargs="+", default=[25_000, 50_000, 100_000])
    parser.add_argument("--stage", nargs=2, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.stage:
        print(json.dumps(stage(given.stage[0], Path(given.stage[1]), given.rows[0])))
        return
    measured: dict[str, list[dict[str, float]]] = {name: [] for name in STAGES}
    print("| stage | rows | s | MiB |\n|---|---:|---:|---:|")
    for rows in sorted(given.rows):
        with tempfile.TemporaryDirectory(prefix="qs3-million-") as place:
            start = time.process_time()
            make(Path(place), rows)
            print(f"| (written) | {rows:,} | {time.process_time() - start:.1f} | |", flush=True)
            for name in ("plan", "merge", *STAGES[1:2], *STAGES[3:]):
                command = [sys.executable, __file__, "--rows", str(rows), "--stage", name, place]
                done = subprocess.run(command, check=True, capture_output=True, text=True)
                measured[name].append(figures := json.loads(done.stdout.splitlines()[-1]))
                columns = f"{figures['seconds']:.1f} | {figures['mebibytes']:.0f}"
                print(f"| {name} | {rows:,} | {columns} |", flush=True)
    print("\n| stage | ms a row | bytes a row | a million rows |\n|---|---:|---:|---|")
    few, many = min(given.rows), max(given.rows)
    for name, figures in measured.items():
        first, last = figures[0], figures[-1]
        span = max(many - few, 1)
        seconds = (last["seconds"] - first["seconds"]) / span
        mebibytes = (last["mebibytes"] - first["mebibytes"]) / span
        rest = 1_000_000 - many
        print(
            f"| {name} | {1e3 * seconds:.3f} | {mebibytes * 2**20:.0f} | "
            f"{(last['seconds'] + rest * seconds) / 60:.1f} min, "
            f"{(last['mebibytes'] + rest * mebibytes) / 1024:.2f} GiB |"
        )


if __name__ == "__main__":
    main()
