"""Reading clouds: our Parquet store beside npy files, HDF5 and Zarr, in one run.

    python benchmarks/store.py --clouds 5000 --points 2048

The same clouds are written in every form, ours with the noisy cloud alone and as `qs3 generate`
writes it, with the clean twin and the surface beside it. Measured, medians after one warm-up,
turns of all forms interleaved: the whole set into one array; single clouds and batches of 32 at
random. What each whole reading does: ours is `read_ragged`, which checks every page's checksum and
every label, refuses points that are not finite, sums all up by SHA-256 and uses up to 8 threads;
npy and HDF5 just read, on one thread; Zarr uses its own threads. Our store has no access by row: a
random cloud costs the reading of that column of its shard (64 rows) by pyarrow, with no checks.
Needs zarr (extra dev). The files are in the page cache.
"""

import argparse
import os
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pyarrow.parquet as pq
import zarr

from qs3.io.layouts.store import read_ragged
from qs3.store.folder import open_folder
from qs3.store.manifest import Manifest, shard_name, write_manifest
from qs3.store.shards import CloudRow, DType, put_shard, table_of

ROWS = 64
Reader = Callable[[np.ndarray | None], np.ndarray]
"""Reads the rows asked for, or all."""


def make(count: int, points: int) -> np.ndarray:
    """Boxes and ellipsoids seen from one side, with noise along the line of sight."""
    rng = np.random.default_rng(0)
    clouds = np.zeros((count, points, 3), np.float32)
    for index in range(count):
        cloud = rng.normal(size=(points, 3))
        cloud /= np.linalg.norm(cloud, axis=1, keepdims=True)
        if index % 2:
            cloud /= np.abs(cloud).max(axis=1, keepdims=True)
        size = rng.uniform(0.2, 1.0, 3)
        cloud *= 0.5 * size / size.max()
        sight = rng.normal(size=3)
        sight /= np.linalg.norm(sight)
        hidden = cloud @ sight < -0.1
        cloud[hidden] *= -1.0
        clouds[index] = cloud + rng.normal(0, 0.01, (points, 1)) * sight
    return clouds


def write_store(folder: Path, clouds: np.ndarray, dtype: DType, whole: bool) -> Reader:
    nothing, none = np.zeros((0, 3), np.float32), np.zeros(0, np.uint8)
    view = np.random.default_rng(2).integers(0, 5, clouds.shape[1], dtype=np.uint8)
    shards = -(-len(clouds) // ROWS)
    folder.mkdir()
    write_manifest(folder, Manifest({"dtype": dtype}, ("a", "b"), len(clouds), shards, {}))
    for shard in range(shards):
        rows = []
        for i in range(shard * ROWS, min((shard + 1) * ROWS, len(clouds))):
            other = clouds[i] if whole else nothing
            rows.append(
                CloudRow(
                    f"m{i}#0", f"m{i}", 0, i % 2, "ab"[i % 2], "train", i, clouds[i], view,
                    other, view if whole else none, other,
                )
            )  # fmt: skip
        put_shard(open_folder(folder), shard, table_of(rows, dtype))

    def read(rows: np.ndarray | None) -> np.ndarray:
        if rows is None:
            return np.stack(read_ragged(folder).clouds)
        found = np.zeros((len(rows), *clouds.shape[1:]), np.float32)
        for shard in np.unique(rows // ROWS):
            column = pq.read_table(folder / shard_name(int(shard)), columns=["points"])["points"]
            mine = np.flatnonzero(rows // ROWS == shard)
            for place in mine:
                values = column[int(rows[place] % ROWS)].values.to_numpy(zero_copy_only=False)
                found[place] = values.reshape(-1, 3)
        return found

    return read


def write_npy(folder: Path, clouds: np.ndarray) -> Reader:
    folder.mkdir()
    paths = [folder / f"{i:06d}.npy" for i in range(len(clouds))]
    for path, cloud in zip(paths, clouds, strict=True):
        np.save(path, cloud)
    return lambda rows: np.stack(
        [np.load(path) for path in (paths if rows is None else [paths[i] for i in rows])]
    )


def write_h5(path: Path, clouds: np.ndarray, chunked: bool) -> Reader:
    chunks = (1, *clouds.shape[1:]) if chunked else None
    with h5py.File(path, "w") as file:
        file.create_dataset("points", data=clouds, chunks=chunks)
    file = h5py.File(path, "r")

    def read(rows: np.ndarray | None) -> np.ndarray:
        data = file["points"]
        assert isinstance(data, h5py.Dataset)
        if rows is None:
            return data[:]
        order = np.argsort(rows)  # h5py wants rising rows
        found = np.zeros((len(rows), *clouds.shape[1:]), np.float32)
        found[order] = data[rows[order]]
        return found

    return read


def write_zarr(path: Path, clouds: np.ndarray, rows_a_chunk: int) -> Reader:
    shape = (rows_a_chunk, *clouds.shape[1:])
    array = zarr.create_array(str(path), shape=clouds.shape, chunks=shape, dtype="float32")
    array[:] = clouds
    return lambda rows: np.asarray(array[:] if rows is None else array.oindex[rows])


def size(path: Path) -> float:
    files = [path] if path.is_file() else [p for p in path.rglob("*") if p.is_file()]
    return sum(file.stat().st_size for file in files) / 1e6


def main() -> None:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--clouds", type=int, default=5000)
    parser.add_argument("--points", type=int, default=2048)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--folder", type=Path)
    options = parser.parse_args()
    with tempfile.TemporaryDirectory(dir=options.folder) as root:
        compare(make(options.clouds, options.points), options.repeats, Path(root))


def compare(clouds: np.ndarray, repeats: int, root: Path) -> None:
    both = "with clean and surface"
    writers: dict[str, Callable[[Path], Reader]] = {
        "ours, float32": lambda path: write_store(path, clouds, "float32", False),
        "ours, float16": lambda path: write_store(path, clouds, "float16", False),
        f"ours, float32, {both}": lambda path: write_store(path, clouds, "float32", True),
        f"ours, float16, {both}": lambda path: write_store(path, clouds, "float16", True),
        "npy, a file a cloud": lambda path: write_npy(path, clouds),
        "HDF5, contiguous": lambda path: write_h5(path, clouds, False),
        "HDF5, a chunk a cloud": lambda path: write_h5(path, clouds, True),
        "Zarr, a chunk a cloud": lambda path: write_zarr(path, clouds, 1),
        "Zarr, 64 clouds a chunk": lambda path: write_zarr(path, clouds, 64),
    }
    forms = {name: write(root / str(n)) for n, (name, write) in enumerate(writers.items())}
    rng = np.random.default_rng(1)
    seconds: dict[tuple[str, str], list[float]] = {}
    for turn in range(repeats + 1):
        tasks: dict[str, list[np.ndarray | None]] = {
            "whole": [None],
            "single": [rng.integers(0, len(clouds), 1) for _ in range(40)],
            "batch": [rng.choice(len(clouds), 32, replace=False) for _ in range(10)],
        }
        for name, read in forms.items():
            half = "float16" in name
            for kind, asked in tasks.items():
                start = time.perf_counter()
                for rows in asked:
                    read(rows)
                spent = (time.perf_counter() - start) / len(asked)
                wanted = clouds if asked[-1] is None else clouds[asked[-1]]
                if half:
                    wanted = wanted.astype(np.float16)
                assert np.array_equal(read(asked[-1]), wanted)
                if turn:
                    seconds.setdefault((name, kind), []).append(spent)
    print(
        f"{len(clouds)} clouds of {clouds.shape[1]} points, {repeats} turns, {os.cpu_count()} cores"
    )
    print(f"load {os.getloadavg()[0]:.1f}\n")
    print("| | MB | whole, s (min–max) | one cloud, ms | batch of 32, ms |")
    print("|---|---|---|---|---|")
    for number, name in enumerate(forms):
        whole, single, batch = (seconds[name, kind] for kind in ("whole", "single", "batch"))
        print(
            f"| {name} | {size(root / str(number)):.0f} "
            f"| {statistics.median(whole):.2f} ({min(whole):.2f}–{max(whole):.2f}) "
            f"| {1e3 * statistics.median(single):.2f} | {1e3 * statistics.median(batch):.1f} |"
        )


if __name__ == "__main__":
    main()
