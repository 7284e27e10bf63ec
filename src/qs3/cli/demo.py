"""``qs3 demo``: adapt the network that comes with qs3 to a camera, without labels."""

from collections import Counter
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from qs3.cli.text import columns, show, tell
from qs3.errors import InputError
from qs3.files import claim_folder, write_bytes, write_json, write_text
from qs3.io.clouds import PointClouds
from qs3.meshes import POINTDA10, collect, sample_surface
from qs3.meshes.sizes import class_size

_NETWORK, _SENSOR = "rooms", "d435"
_SAMPLES = 4  # rays a pixel
_TARGET, _SOURCE, _SURFACES = 15, 10, 60  # objects a class
_EPOCHS, _POINTS = 30, 1024  # of the training on surfaces, and of each surface
_ROUNDS = {"threshold_share": 0.5, "rounds": 5, "epochs": 4, "source_loss": True}


def demo(
    out: Path = Path("demo"), scans: Path | None = None, seed: int = 0, workers: int = 2
) -> int:
    """Adapt a network that comes with qs3 to a camera, without labels: scan, adapt, report.

    Args:
        out: Folder to write; run again after a stop to go on.
        scans: Folder of your own scans in place of simulated ones: files of points, one object
            each, z up, in metres. They have no labels, so nothing is scored.
        seed: Root of all seeds.
        workers: Processes that scan.
    """
    import qs3
    from qs3.cli.report import with_scan
    from qs3.cli.train import NO_ROUND
    from qs3.report import collect as report
    from qs3.report.page import write_report
    from qs3.training import evaluate, read_run
    from qs3.training.answers import answers_csv, list_clouds, predict_files, read_listed
    from qs3.training.shipped import WEIGHTS

    if seed < 0:
        raise InputError(f"--seed {seed}: must not be negative")
    if scans is not None and not scans.is_dir():
        raise InputError(f"{scans}: no such folder; name a folder of scans for --scans")
    files = [] if scans is None else list_clouds([scans])
    for file in files:
        read_listed(file)  # a fault comes before any scan
    folder = claim_folder(out, "demo.json")
    write_json(folder / "demo.json", {"seed": seed})
    before, target, run = folder / "before", folder / "target", folder / "adapted" / "run"
    for file in (WEIGHTS / _NETWORK).iterdir():
        write_bytes(before / file.name, file.read_bytes())
    # The network has seen the shapes of seed 0.
    tell("scan a small source: built-in shapes in rooms, random cameras")
    _scan(folder / "source", _SOURCE, 2000 + seed, workers)
    if scans is None:
        tell(f"scan the target: other shapes, single views by the sensor {_SENSOR}")
        _scan(target, _TARGET, 1000 + seed, workers, sensor=_SENSOR)
        tell("train a network on whole surfaces only, for comparison")
        _learn_surfaces(folder / "surfaces", before, seed)
    tell("adapt to the target without labels")
    qs3.adapt(folder / "source", target if scans is None else scans, folder / "adapted",
              warm_up=before, self_training=_ROUNDS, seed=seed)  # fmt: skip
    if scans is None:
        names = {"surfaces": "surfaces only", "before": _NETWORK, "adapted/run": "QBST"}
        for place, name in names.items():
            scores = evaluate(folder / place, target).scores
            low, high = scores.interval
            show(f"accuracy on the target, {name + ':':14} {scores.accuracy:.1%}  "
                 f"(95 % interval {low:.0%} to {high:.0%})")  # fmt: skip
        page = report.collect(run, data=str(target), source=str(folder / "source"), before=before)
        page = with_scan(page, "chair", _SENSOR)
    else:
        page = report.collect(run)
        first, last = (list(predict_files(place, files)) for place in (before, run))
        write_text(folder / "predictions.csv", answers_csv(last, top=3))
        old, new = (Counter(said.best()[0][0] for said in answers) for answers in (first, last))
        rows = [(name, str(old[name]), str(new[name])) for name in page.class_names]
        show(*columns([("class", "before", "after"), *rows], 1), folder / "predictions.csv")
    write_report(folder / "report.html", page)
    show(f"report: {folder / 'report.html'}")
    return NO_ROUND if all(done["skipped"] for done in read_run(run).rounds) else 0


def _scan(folder: Path, per_class: int, seed: int, workers: int, **how: Any) -> None:
    from qs3.sensor.settings import CameraSettings
    from qs3.store.failures import read_failures
    from qs3.store.generate import generate
    from qs3.store.scan_item import RECIPES

    renderer = CameraSettings(samples=_SAMPLES).make_renderer()
    recipe = replace(RECIPES["rooms"], views=1, per_class=per_class, scans_per_mesh=1,
                     renderer=renderer, seed=seed, rows_per_shard=10, **how)  # fmt: skip
    items = collect("shapes", per_class=per_class, seed=seed)
    generate(items, folder, recipe, workers=workers)
    if failures := read_failures(folder):
        tell(f"{len(failures)} of {len(items)} scans failed; the first: {failures[0]['reason']}")


def _learn_surfaces(folder: Path, like: Path, seed: int) -> None:
    """Train a network with the settings of another one on whole surfaces, seen by no camera."""
    from qs3.training import fit
    from qs3.training.config import LIGHT
    from qs3.training.run import train_settings

    rng, points = np.random.default_rng(3000 + seed), []
    items = collect("shapes", per_class=_SURFACES, seed=3000 + seed)
    for item in items:
        mesh = item.load()
        scale = class_size(mesh, item.class_name, rng) / mesh.extents.max()
        points.append(sample_surface(mesh, _POINTS, rng) * np.float32(scale))
    labels = np.array([POINTDA10.index(item.class_name) for item in items])
    clouds = PointClouds(np.stack(points), labels, POINTDA10, tuple(item.id for item in items))
    how = {"epochs": _EPOCHS, "holdout": 0.0, "augmentation": LIGHT, "seed": seed}
    fit("source-only", clouds, None, replace(train_settings(like), **how), run_dir=folder)
