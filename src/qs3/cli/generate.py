"""``qs3 generate``: many meshes in, one data set out."""

import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro

from qs3.cli.camera import CameraOptions
from qs3.cli.scene import SceneOptions
from qs3.errors import InputError


@dataclass(frozen=True)
class GenerateOptions:
    """Scan a folder of meshes, or the built-in shapes, into a folder of Parquet shards."""

    meshes: str
    """A folder of meshes (one folder a class), or `shapes` for the built-in ones."""
    out: Path
    """Folder of the data set; run the same command again to go on after a stop."""
    seed: int = 0
    """Root of all seeds; another seed draws other shapes and other poses."""
    per_class: int = 10
    """Objects a class, of the built-in shapes."""
    scans_per_mesh: int = 1
    """Scans of each object."""
    classes: tuple[str, ...] = ()
    """Classes to scan, by the names of their folders; all by default."""
    workers: int = 1
    """Processes. The bytes written do not depend on it."""
    split: str = ""
    """Name of the split of every row, such as train or test; empty keeps the folder's own."""
    scene: Annotated[SceneOptions, tyro.conf.arg(name="")] = field(default_factory=SceneOptions)
    """What stands around the object, and what is kept. A neighbour is another of the meshes."""
    camera: Annotated[CameraOptions, tyro.conf.arg(name="")] = field(default_factory=CameraOptions)
    """The simulated camera."""


def generate(options: Annotated[GenerateOptions, tyro.conf.arg(name="")]) -> int:
    """Scan many meshes into a data set; resumes, and logs what failed in failures.jsonl."""
    from qs3.datasets.failures import read_failures
    from qs3.datasets.generate import GenerateSettings
    from qs3.datasets.generate import generate as generate_data
    from qs3.meshes import collect

    if options.seed < 0:
        raise InputError(f"--seed {options.seed}: must not be negative")
    items = collect(
        options.meshes,
        per_class=options.per_class,
        seed=options.seed,
        classes=options.classes or None,
    )
    built_in = options.meshes == "shapes"
    names = {item.class_name for item in items}
    if "" in names:
        raise InputError(
            f"{options.meshes}: meshes lie flat in this folder and their classes are unknown; put "
            "them into one folder a class"
        )
    sensor = options.scene.resolve_sensor(options.camera.resolve_sensor())
    settings = GenerateSettings(
        classes=_classes(names),
        meshes="shapes" if built_in else Path(options.meshes).resolve().name,
        per_class=options.per_class if built_in else None,
        scans_per_mesh=options.scans_per_mesh,
        sensor=sensor,
        renderer=options.camera.resolve_renderer(),
        split=options.split or None,
        seed=options.seed,
        **(options.camera.scan_arguments() | options.scene.scan_arguments(sensor)),
    )
    report = generate_data(items, options.out, settings, workers=options.workers)
    print(options.out)
    failures = read_failures(options.out)
    print(
        f"{report.done} scans written, {report.skipped} were there before, "
        f"{len(failures)} failed. Next: qs3 train --source {options.out} --out RUN",
        file=sys.stderr,
    )
    if failures:
        first = failures[0]
        raise InputError(
            f"{options.out / 'failures.jsonl'}: {len(failures)} scans failed; the first: "
            f"{first['id']}: {first['reason']}"
        )
    return 0


def _classes(names: set[str]) -> tuple[str, ...]:
    """PointDA-10's ten classes where all names map onto them, else the folders' own."""
    from qs3.datasets.classes import POINTDA10, canonical

    if all(canonical(name) in POINTDA10 for name in names):
        return POINTDA10
    return tuple(sorted(names))
