"""Reading clouds: our Parquet store beside npy files, HDF5 and Zarr, in one run.

    python benchmarks/store.py --clouds 5000 --points 2048

The same clouds are written in every form. Measured, medians after one warm-up, rounds
interleaved: the whole set into one array; single clouds at random; batches of 32 at random. Our
store is also measured as generate writes it, with the clean twin and the surface beside each
noisy cloud. It has no index by row: a random cloud costs the reading of its shard, which is told.
Needs h5py (core) and zarr (extra dev). The files are in the page cache.
"""

import argparse
import os
import shutil
import statistics
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

import h5py
import numpy as np
import pyarrow.parquet as pq
import zarr

from qs3.datasets.manifest import Manifest, write_manifest
from qs3.datasets.shards import CloudRow, write_shard
from qs3.datasets.store import read_store, shard_path

ROWS = 64
Reader = Callable[[np.ndarray | None], np.ndarray]
"""Reads the rows asked for, or all."""


def make(count: int, points: int) -> np.ndarray:
    """Clouds of a sphere with noise, as compressible as scans are."""
    rng = np.random.default_rng(0)
    clouds = rng.normal(size=(count, points, 3))
    clouds /= np.linalg.norm(clouds, axis=2, keepdims=True)
    return (0.5 * clouds + rng.normal(0, 0.01, clouds.shape)).astype(np.float32)


def write_store(folder: Path, clouds: np.ndarray, dtype: str, whole: bool) -> Reader:
    nothing, none = np.zeros((0, 3), np.float32), np.zeros(0, np.uint8)
    view = np.zeros(clouds.shape[1], np.uint8)
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
        write_shard(shard_path(folder, shard), rows, dtype)

    def read(rows: np.ndarray | None) -> np.ndarray:
        if rows is None:
            return read_store(folder).points
        found = np.zeros((len(rows), *clouds.shape[1:]), np.float32)
        for shard in np.unique(rows // ROWS):
            column = pq.read_table(shard_path(folder, int(shard)), columns=["points"])["points"]
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
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--clouds", type=int, default=5000)
    parser.add_argument("--points", type=int, default=2048)
    parser.add_argument("--repeats", type=int, default=5)
    parser.add_argument("--folder", type=Path)
    options = parser.parse_args()
    root = Path(tempfile.mkdtemp(dir=options.folder))
    clouds = make(options.clouds, options.points)
    forms: dict[str, tuple[Path, Reader]] = {}
    writers: dict[str, Callable[[Path], Reader]] = {
        "ours, float32": lambda path: write_store(path, clouds, "float32", False),
        "ours, float16": lambda path: write_store(path, clouds, "float16", False),
        "ours, with clean and surface": lambda path: write_store(path, clouds, "float32", True),
        "npy, a file a cloud": lambda path: write_npy(path, clouds),
        "HDF5, contiguous": lambda path: write_h5(path, clouds, False),
        "HDF5, a chunk a cloud": lambda path: write_h5(path, clouds, True),
        "Zarr, a chunk a cloud": lambda path: write_zarr(path, clouds, 1),
        "Zarr, 64 clouds a chunk": lambda path: write_zarr(path, clouds, 64),
    }
    for number, (name, write) in enumerate(writers.items()):
        path = root / str(number)
        forms[name] = (path, write(path))
    rng = np.random.default_rng(1)
    seconds: dict[tuple[str, str], list[float]] = {}
    for turn in range(options.repeats + 1):
        singles = [rng.integers(0, len(clouds), 1) for _ in range(40)]
        batches = [rng.choice(len(clouds), 32, replace=False) for _ in range(8)]
        for name, (_, read) in forms.items():
            for kind, asked in (("whole", [None]), ("single", singles), ("batch", batches)):
                start = time.perf_counter()
                for rows in asked:
                    got = read(rows)
                spent = (time.perf_counter() - start) / len(asked)
                wanted = clouds if asked[-1] is None else clouds[asked[-1]]
                assert np.allclose(got, wanted, atol=0 if "float16" not in name else 3e-4)
                if turn:
                    seconds.setdefault((name, kind), []).append(spent)
    print(f"{len(clouds)} clouds of {options.points} points, load {os.getloadavg()[0]:.1f}\n")
    print("| | MB | whole, s | one cloud, ms | batch of 32, ms |\n|---|---|---|---|---|")
    for name, (path, _) in forms.items():
        whole, single, batch = (
            statistics.median(seconds[name, kind]) for kind in ("whole", "single", "batch")
        )
        print(
            f"| {name} | {size(path):.0f} | {whole:.2f} | {1e3 * single:.1f} | {1e3 * batch:.1f} |"
        )
    shutil.rmtree(root)


if __name__ == "__main__":
    main()
