"""Meshes and scans that cost nothing; a module of its own so that worker processes can load it."""

import ctypes
import os
import signal
import time
from pathlib import Path

import numpy as np

from qs3.errors import say_once
from qs3.files import LOCK
from qs3.meshes import MeshItem
from qs3.meshes.classes import POINTDA10
from qs3.points.compiled import compiled
from qs3.store.generate import GenerateSettings, generate, scan_seed
from qs3.store.manifest import Report
from qs3.store.shards import CloudRow

SETTINGS = GenerateSettings(num_points=16, rows_per_shard=4)


def mesh(name: str, class_name: str = "chair", split: str = "train") -> MeshItem:
    """A mesh that cannot be loaded."""
    return MeshItem(name, class_name, split, path=None, shape_seed=None)


def work(count: int, bad: tuple[int, ...] = (), called: str = "bad") -> list[MeshItem]:
    """A work list of chairs, some of them bad; their name tells how (see ``deadly_row``)."""
    return [mesh(f"{called}{i}" if i in bad else f"m{i}") for i in range(count)]


def run(items, out, settings=SETTINGS, *, row=None, **options) -> Report:
    """Generate in this process where nothing else is said: these scans cost nothing."""
    options = {"workers": 0, "progress": False} | options
    return generate(items, out, settings, scan_one=row or fake_row, **options)


def content(folder: Path) -> dict[str, bytes]:
    """Every file of a data set but its lock."""
    return {path.name: path.read_bytes() for path in folder.iterdir() if path.name != LOCK}


def fake_row(item: MeshItem, scan: int, settings: GenerateSettings) -> CloudRow:
    seed = scan_seed(settings.seed, item.id, scan)
    rng = np.random.default_rng(seed)
    n = settings.num_points
    return CloudRow(
        id=f"{item.id}#{scan}",
        object=item.id,
        scan=scan,
        label=POINTDA10.index(item.class_name),
        class_name=item.class_name,
        split=item.split,
        seed=seed,
        points=rng.random((n, 3), dtype=np.float32),
        view=rng.integers(0, settings.views, n, dtype=np.uint8),
        clean=rng.random((n, 3), dtype=np.float32),
        clean_view=np.zeros(n, dtype=np.uint8),
        surface=rng.random((n, 3), dtype=np.float32),
        yaw=float(rng.random()),
        valid_fraction=0.9,
    )


def flaky_row(item: MeshItem, scan: int, settings: GenerateSettings) -> CloudRow:
    if item.id.startswith("bad"):
        raise ValueError(f"{item.id} is broken\nsecond line")
    return fake_row(item, scan, settings)


def unavailable_row(item: MeshItem, scan: int, settings: GenerateSettings) -> CloudRow:
    raise ModuleNotFoundError("No module named 'nowhere'")


def compiling_row(item: MeshItem, scan: int, settings: GenerateSettings) -> CloudRow:
    compiled(fake_row)
    return fake_row(item, scan, settings)


def warning_row(item: MeshItem, scan: int, settings: GenerateSettings) -> CloudRow:
    say_once(f"{item.id} has few points", kind="few points of a test")
    return fake_row(item, scan, settings)


def slow_row(item: MeshItem, scan: int, settings: GenerateSettings) -> CloudRow:
    time.sleep(0.05)
    return fake_row(item, scan, settings)


def deadly_row(item: MeshItem, scan: int, settings: GenerateSettings) -> CloudRow:
    """Hang, crash or end the process, by the object's name."""
    if item.id.startswith("hangs"):
        ctypes.PyDLL(None).sleep(600)  # the interpreter locked, as by a parser written in C
    if item.id.startswith("crashes"):
        os.kill(os.getpid(), signal.SIGSEGV)
    if item.id.startswith("exits"):
        os._exit(9)
    if item.id.startswith("is told to end"):
        os.kill(os.getpid(), signal.SIGTERM)
        time.sleep(5)
    return fake_row(item, scan, settings)


def marked_row(item: MeshItem, scan: int, settings: GenerateSettings) -> CloudRow:
    """Fail as long as the file is there that QS3_FAKE_MARKER names."""
    if item.id.startswith("bad") and Path(os.environ["QS3_FAKE_MARKER"]).exists():
        raise ValueError(f"{item.id} is broken")
    return fake_row(item, scan, settings)


def slow_flaky_row(item: MeshItem, scan: int, settings: GenerateSettings) -> CloudRow:
    time.sleep(0.25)
    return flaky_row(item, scan, settings)
