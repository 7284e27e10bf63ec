"""Furniture: adapt the network `rooms` to a camera without labels, by scans of built-in shapes.

Takes some minutes on two cores. Other shapes, scanned from one side by one simulated sensor, play
the real camera. It prints the accuracy of three networks: trained on whole surfaces only, `rooms`,
and `rooms` after quasi-balanced self-training; and writes a page, out/rooms/report.html.
"""

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from qs3.answers import evaluate
from qs3.clouds.load import load_clouds
from qs3.clouds.types import PointClouds
from qs3.files import write_bytes
from qs3.meshes import POINTDA10, collect, sample_surface
from qs3.meshes.sizes import class_size
from qs3.report.collect import collect as collect_report
from qs3.report.page import write_report
from qs3.runs.bundled import WEIGHTS
from qs3.runs.run import train_settings
from qs3.runs.settings import LIGHT, PRESETS
from qs3.store.generate import generate
from qs3.store.scan_item import RECIPES, settings_for
from qs3.training import fit

ROOMS = WEIGHTS / "rooms"
TARGET, SOURCE, SURFACES = 15, 10, 60  # objects per class
EPOCHS, POINTS = 30, 1024  # of the training on surfaces, and of each surface
ROUNDS = {"threshold_share": 0.5, "rounds": 5, "epochs": 4, "source_loss": True}


def scan(folder: Path, per_class: int, seed: int, **how: Any) -> None:
    """Scan built-in shapes in rooms, one view each; `rooms` has seen those of seed 0."""
    items = collect("shapes", per_class=per_class, seed=seed)
    recipe = replace(RECIPES["rooms"], views=1, scans_per_mesh=1, seed=seed, **how)
    generate(items, folder, settings_for(recipe, items, ["shapes"], per_class), workers=2)


def surfaces(seed: int) -> PointClouds:
    """Sample whole surfaces, seen by no camera, in the sizes of their classes."""
    rng, points = np.random.default_rng(seed), []
    items = collect("shapes", per_class=SURFACES, seed=seed)
    for item in items:
        mesh = item.load()
        scale = class_size(mesh, item.class_name, rng) / mesh.extents.max()
        points.append(sample_surface(mesh, POINTS, rng) * np.float32(scale))
    labels = np.array([POINTDA10.index(item.class_name) for item in items])
    return PointClouds(np.stack(points), labels, POINTDA10, tuple(item.id for item in items))


def main(folder: Path) -> None:
    """Scan, train, adapt, score."""
    source, target = folder / "source", folder / "target"
    scan(source, SOURCE, 2000)
    scan(target, TARGET, 1000, sensor="d435")
    how = replace(train_settings(ROOMS), seed=0)
    plain = replace(how, epochs=EPOCHS, holdout=0.0, augmentation=LIGHT)
    fit("source-only", surfaces(3000), None, plain, run_dir=folder / "surfaces")
    clouds = load_clouds(source, num_points=None, cloud="all", class_names=POINTDA10)
    unlabelled = load_clouds(target, num_points=None).without_labels()
    rounds = replace(PRESETS["gentle"], rule="qbst", **ROUNDS)
    for file in ROOMS.iterdir():
        write_bytes(folder / "before" / file.name, file.read_bytes())
    fit("qbst", clouds, unlabelled, how, rounds, run_dir=folder / "adapted",
        warm_up=folder / "before")  # fmt: skip
    names = {"surfaces": "surfaces only", "before": "rooms", "adapted": "QBST"}
    for run, name in names.items():
        scores = evaluate(folder / run, target).scores
        low, high = scores.interval
        print(f"{name}: {scores.accuracy:.1%} (95 % interval {low:.0%} to {high:.0%})")
    page = collect_report(folder / "adapted", data=str(target), source=str(source),
                          before=folder / "before")  # fmt: skip
    write_report(folder / "report.html", page)
    print(folder / "report.html")


if __name__ == "__main__":
    main(Path("out/rooms"))
