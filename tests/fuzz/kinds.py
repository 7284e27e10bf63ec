"""A small valid file or folder of every kind, and the way in which the package loads it."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import h5py
import numpy as np

from qs3 import shapes
from qs3.clouds.files import read_cloud
from qs3.clouds.layouts import formats
from qs3.clouds.layouts.store import read_ragged
from qs3.clouds.load import load_clouds
from qs3.clouds.types import RaggedClouds
from qs3.meshes import load_mesh
from qs3.meshes.classes import POINTDA10
from qs3.runs import TrainSettings
from qs3.runs.run import read_run
from qs3.sensor import presets
from qs3.sensor.presets import load_sensor
from qs3.store.info import info
from qs3.training import fit
from qs3.training.predict import load_model

from ..stores import write_store


@dataclass(frozen=True)
class Kind:
    build: Callable[[Path], None]
    load: Callable[[Path], Any]
    name: str = "data"


def clouds() -> RaggedClouds:
    points = np.random.default_rng(0).normal(size=(6, 64, 3)).astype(np.float32)
    ids = tuple(f"cloud {i}" for i in range(6))
    return RaggedClouds(
        list(points), ids, "", np.arange(6) % 3, POINTDA10, ("train",) * 3 + ("test",) * 3
    )


def _layout(layout: str, name: str = "data") -> Kind:
    def build(path: Path) -> None:
        write = formats()[layout].write
        assert write is not None
        write(path, clouds())

    return Kind(build, partial(load_clouds, num_points=32), name)


def build_generated(path: Path) -> None:
    write_store(path, POINTDA10, [(i % 3, "train", 64) for i in range(6)], shards=2)


def _load_generated(path: Path) -> Any:
    info(path)
    return [read_ragged(path, cloud) for cloud in ("points", "clean", "surface")]


def _build_text(path: Path) -> None:
    rows = [" ".join(f"{x:.6g}" for x in row) for row in clouds().clouds[0]]
    path.write_text("x y z\n" + "\n".join(rows) + "\n")


def _build_csv(path: Path) -> None:
    rows = [
        ",".join([str(i), *(f"{x:.6g}" for x in row)]) for i, row in enumerate(clouds().clouds[0])
    ]
    path.write_text("# measured\n,x [mm],y [mm],z [mm]\n" + "\n".join(rows) + "\n")


def _build_h5(path: Path) -> None:
    with h5py.File(path, "w") as file:
        file["data"], file["label"] = np.stack(clouds().clouds), clouds().labels


def _build_lists(path: Path) -> None:
    data = clouds()
    for part in ("train", "test"):
        names = [
            f"{POINTDA10[i % 3]}_{i:04d}" for i, split in enumerate(data.splits) if split == part
        ]
        path.mkdir(exist_ok=True)
        (path / f"modelnet40_{part}.txt").write_text("\n".join(names))
        for name in names:
            (path / name[:-5]).mkdir(exist_ok=True)
            _build_text(path / name[:-5] / f"{name}.txt")


def _build_pcd(path: Path) -> None:
    head = "FIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nPOINTS 64\nDATA binary\n"
    path.write_bytes(head.encode() + clouds().clouds[0].tobytes())


def _mesh(ending: str) -> Kind:
    def build(path: Path) -> None:
        data: Any = shapes.make("table", 0).export(file_type=ending)
        path.write_bytes(data if isinstance(data, bytes) else data.encode())

    return Kind(build, load_mesh, f"mesh.{ending}")


def _build_sensor(path: Path) -> None:
    cameras = Path(presets.__file__).with_name("cameras.toml").read_text(encoding="utf-8")
    path.write_text(cameras.partition("[qs3-800]")[2].partition("\n[")[0], encoding="utf-8")


def build_run(path: Path) -> None:
    network = {"channels": [4, 4, 8], "hidden": [4], "transforms": False}
    settings = TrainSettings(
        model="pointnet", model_settings=network, num_points=16, epochs=1, batch_size=3, threads=1
    )
    source = clouds().labelled(None, None, "clouds")
    fit("source-only", source, None, settings, run_dir=path)


def _load_run(path: Path) -> Any:
    return load_model(path), read_run(path)


KINDS = {
    "sensor": Kind(_build_sensor, load_sensor, "camera.toml"),
    "run": Kind(build_run, _load_run),
    "generated": Kind(build_generated, _load_generated),
    "npz": _layout("npz", "clouds.npz"),
    "h5": Kind(_build_h5, partial(load_clouds, num_points=32), "ply_data_train0.h5"),
    "ply": _layout("ply"),
    "npy": Kind(lambda path: np.save(path, clouds().clouds[0]), read_cloud, "a.npy"),
    "xyz": Kind(_build_text, read_cloud, "a.xyz"),
    "csv": Kind(_build_csv, read_cloud, "a.csv"),
    "lists": Kind(_build_lists, partial(load_clouds, num_points=32)),
    "pcd": Kind(_build_pcd, read_cloud, "a.pcd"),
    **{f"mesh-{ending}": _mesh(ending) for ending in ("off", "obj", "ply", "stl", "glb")},
}
