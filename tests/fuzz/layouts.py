"""A small valid data set of every layout, and the package's own way to load it."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from qs3.io.clouds import RaggedClouds
from qs3.meshes.classes import POINTDA10

CLASSES = POINTDA10


OWN_CLASSES = {
    "scanobjectnn": ("bag", "bin", "box"),
    "graspnetpc10-real-kinect": ("box", "can", "banana"),
}
"""Classes of the layouts that cannot hold PointDA-10's."""

POINTS = {
    "modelnet40-h5": 2048,
    "scanobjectnn": 2048,
    "pointda10-h5": 2048,
    "pointda10-npy": 2048,
    "specklenet10": 2048,
    "graspnetpc10-real-kinect": 1024,
}
"""Layouts of clouds of one size."""


@dataclass(frozen=True)
class Layout:
    """One layout."""

    build: Callable[[Path], None]
    """Write the valid data set into a new folder."""
    load: Callable[[Path], Any]
    """Load it, as the commands do."""
    inside: str = ""
    """What to load, below the folder."""

    def path(self, folder: Path) -> Path:
        return folder / self.inside if self.inside else folder


def clouds(points: int = 64, classes: tuple[str, ...] = CLASSES) -> RaggedClouds:
    rng = np.random.default_rng(0)
    return RaggedClouds(
        clouds=[rng.normal(size=(points, 3)).astype(np.float32) for _ in range(6)],
        ids=tuple(f"{classes[i % 3]}/{i:03d}" for i in range(6)),
        checksum="0" * 64,
        labels=np.arange(6) % 3,
        class_names=classes,
        splits=("train", "train", "train", "test", "test", "test"),
    )


def load_any(path: Path) -> Any:
    from qs3.io.load import load_clouds

    return load_clouds(path, num_points=32)


def written_as(name: str) -> Callable[[Path], None]:
    def build(folder: Path) -> None:
        from qs3.io.layouts import FORMATS

        FORMATS[name].write(folder, clouds(POINTS.get(name, 64), OWN_CLASSES.get(name, CLASSES)))

    return build


def read_as(name: str) -> Callable[[Path], Any]:
    def load(path: Path) -> Any:
        from qs3.io.load import read_clouds

        return read_clouds(path, origin=name)

    return load


def layout(name: str) -> Layout:
    return Layout(written_as(name), read_as(name))


def build_generated(folder: Path) -> None:
    """A data set as ``generate`` makes it, every kind of cloud filled."""
    from ..stores import write_store

    write_store(folder, CLASSES, [(index % 3, "train", 64) for index in range(6)], shards=2)


def load_generated(path: Path) -> Any:
    from qs3.io.layouts.store import read_ragged
    from qs3.store.info import check, info

    check(path, progress=False)
    info(path)
    return [read_ragged(path, cloud) for cloud in ("points", "clean", "surface")]


def build_npz(folder: Path) -> None:
    folder.mkdir()
    given = clouds()
    np.savez_compressed(
        folder / "clouds.npz",
        points=np.stack(given.clouds).astype(np.float16),
        label=np.arange(6) % 3,
        class_names=np.array(CLASSES),
        is_train=np.arange(6) < 3,
    )


def build_meshes(ending: str) -> Callable[[Path], None]:
    def build(folder: Path) -> None:
        from qs3 import shapes

        (folder / "chair").mkdir(parents=True)
        mesh = shapes.make("table", 0)
        data: Any = mesh.export(file_type=ending)
        path = folder / "chair" / f"one.{ending}"
        path.write_bytes(data if isinstance(data, bytes) else data.encode())

    return build


def load_meshes(path: Path) -> Any:
    from qs3.meshes import collect

    return [item.load() for item in collect(str(path))]


def build_sensor(folder: Path) -> None:
    import contextlib

    from qs3.cli import main

    folder.mkdir()
    with (
        (folder / "camera.toml").open("w") as file,
        contextlib.redirect_stdout(file),
        contextlib.suppress(SystemExit),
    ):
        main(["sensors", "show", "d435"])


def load_sensor(path: Path) -> Any:
    from qs3.sensor.presets.toml_file import load_sensor

    return load_sensor(path)


def build_run(folder: Path) -> None:
    """A run as ``train`` leaves it, with the record of ``evaluate``."""
    from qs3.training import TrainSettings, evaluate, fit

    data = folder.with_name(f"{folder.name}-data")
    build_generated(data)
    network = {"channels": [4, 4, 8], "hidden": [4], "transforms": False}
    settings = TrainSettings(
        model="pointnet", model_settings=network, num_points=16, epochs=1, batch_size=3, threads=1
    )
    fit("source-only", load_any(data), None, settings, run_dir=folder)
    evaluate(folder, data)
    for leftover in (folder / "history.jsonl", *folder.rglob("events.*")):
        leftover.unlink(missing_ok=True)


def load_run(path: Path) -> Any:
    from qs3.evaluation.records import read_record
    from qs3.training.checkpoint import load_model
    from qs3.training.run import read_run

    records = [read_record(record) for record in sorted((path / "records").iterdir())]
    return load_model(path), read_run(path), records


LAYOUTS: dict[str, Layout] = {
    "sensor": Layout(build_sensor, load_sensor, "camera.toml"),
    "run": Layout(build_run, load_run),
    "generated": Layout(build_generated, load_generated),
    "npz": Layout(build_npz, load_any, "clouds.npz"),
    **{name: layout(name) for name in ("store", "ply", "pcd", "npy", "xyz", *POINTS)},
    **{
        f"mesh-{e}": Layout(build_meshes(e), load_meshes)
        for e in ("off", "obj", "ply", "stl", "glb")
    },
}
