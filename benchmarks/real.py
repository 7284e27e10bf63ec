"""Simulated sources and self-training on real objects: NYU Depth v2's, and SUN RGB-D's beside them.

Run: python benchmarks/real.py --source DIR --shared DIR --out runs/real [--records results/real]
         [--cells M S ...] [--seeds 0 1 2] [--workers 2] [--check] [--dry-run]

DIR of --source is what `qs3 generate --recipe rooms` made; --shared holds nyuv2_objects.npz and
sunrgbd_objects.npz. The real objects are NYU's `strict` ones. Frames are in the order of filming:
those of the first 70 % of the frames are adapted to, without labels, and scored for development;
those of the last 30 % are scored with --check alone. Each run is a process of one thread; one that
was stopped goes on, one that has its records is not made again. Records are written as they come,
into --records: those of the last 30 % tell by their number how often it was looked at.
"""

import argparse
import concurrent.futures
import functools
import operator
import os
import subprocess
import sys
import time
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from qs3.answers import evaluate
from qs3.clouds.load import load_clouds
from qs3.clouds.preparation import PAPER, ROBUST, Preparation
from qs3.clouds.types import CloudChoice, PointClouds, UnlabelledClouds
from qs3.evaluation.metrics import SeedComparison
from qs3.evaluation.records import RECORDS, RunRecord, append_record, read_records
from qs3.meshes.classes import POINTDA10
from qs3.runs.settings import (
    GENTLE,
    LIGHT,
    PRESETS,
    Augmentation,
    PresetName,
    TrainSettings,
)
from qs3.training import fit

BATCH = 32
SIZED = replace(ROBUST, size_input=True)
FAST: Mapping[str, Any] = {"transforms": False}
"""PointNet without its T-Nets, the fast network: 4 ms of one core for a cloud of 256 points."""


@dataclass(frozen=True)
class Cell:
    """A training, to be made once a seed."""

    cloud: CloudChoice = "all"
    method: str = "source-only"
    preset: PresetName = "default"
    network: str = "pointnet"
    steps: int = 4000
    preparation: Preparation = SIZED
    augmentation: Augmentation = LIGHT
    train: Mapping[str, Any] = field(default_factory=dict)
    rounds: Mapping[str, Any] = field(default_factory=dict)
    warm_up: str = ""


SEEN = replace(LIGHT, sight=1.0)
ALL = Cell()
SCANS = Cell(cloud="points")
ROUNDS = replace(SCANS, method="qbst", warm_up="S again")
CUT = replace(LIGHT, plane=0.75, plane_share=0.6)
ROOMS = replace(ALL, preparation=replace(SIZED, align=True), augmentation=SEEN)
GENTLY = replace(ROOMS, method="qbst", warm_up="rooms")
DGCNN = replace(ALL, network="dgcnn", steps=2000)
CELLS: Mapping[str, Cell] = {
    # Sources, equal numbers of steps.
    "M": replace(ALL, cloud="surface"),
    "C": replace(ALL, cloud="clean"),
    "S": SCANS,
    "S+C+M": ALL,
    # Adaptation, from the warm-up S+C+M of the same seed.
    "QBST": replace(ALL, method="qbst", warm_up="S+C+M"),
    "SPST": replace(ALL, method="spst", warm_up="S+C+M"),
    # The network that comes with qs3, and self-training from it.
    "rooms": ROOMS,
    "rooms QBST": replace(ROOMS, method="qbst", warm_up="rooms"),
    "rooms QBST average": replace(
        ROOMS, method="qbst", rounds={"teacher": "average"}, warm_up="rooms"
    ),
    "rooms QBST gentle": replace(
        ROOMS,
        method="qbst",
        rounds={"teacher": "average", "threshold_share": 0.5, "rounds": 5, "epochs": 4},
        train={"learning_rate": 1e-4},
        warm_up="rooms",
    ),
    "rooms SPST gentle": replace(
        ROOMS, method="spst", rounds={**GENTLE, "rule": "spst"}, warm_up="rooms"
    ),
    # Further such rounds, chosen after the ones before had been scored.
    "rooms QBST gentle, more": replace(GENTLY, rounds={**GENTLE, "threshold_share": 0.8}),
    "rooms QBST gentle, faster": replace(GENTLY, rounds={**GENTLE, "learning_rate": 3e-4}),
    "rooms SPST": replace(ROOMS, method="spst", warm_up="rooms"),
    "rooms DGCNN": replace(ROOMS, network="dgcnn", steps=3000),
    # The recipe since the D435 and D455 stand in a lit room, and rooms of little depth are redrawn.
    "S lit": SCANS,
    "S+C+M lit": ALL,
    "rooms lit": ROOMS,
    # The same recipe since glossy materials carry no noise of the renderer.
    "rooms, light mended": ROOMS,
    # Scans and trainings of S lit repeated on another machine: what follows is held against these.
    "S again": SCANS,
    # Presets of self-training from scans alone, then its switches, one at a time.
    "S QBST paper": replace(ROUNDS, preset="paper"),
    "S SPST": replace(ROUNDS, method="spst", preset="spst"),
    "S QBST": ROUNDS,
    "S QBST gentle": replace(ROUNDS, preset="gentle"),
    "S QBST gentle, alone": replace(ROUNDS, preset="gentle", rounds={"source_loss": False}),
    "S QBST by share": replace(ROUNDS, rounds={"threshold_share": 0.5}),
    "S QBST average": replace(ROUNDS, rounds={"teacher": "average"}),
    # A rival that sees the target from the first step, and the same rounds after it.
    "S GAST": replace(SCANS, method="gast"),
    "S GAST+QBST": replace(SCANS, method="gast", rounds={"rule": "qbst"}, warm_up="S GAST"),
    # The same by the preset that rounds of QBST have by default.
    "S GAST+QBST gentle": replace(
        SCANS, method="gast", preset="gentle", rounds={"rule": "qbst"}, warm_up="S GAST"
    ),
    # The paper's network, one seed where three cost too much.
    "DGCNN M": replace(DGCNN, cloud="surface"),
    "DGCNN S": replace(DGCNN, cloud="points"),
    "DGCNN S+C+M": DGCNN,
    "DGCNN QBST": replace(DGCNN, method="qbst", warm_up="DGCNN S+C+M"),
    "DGCNN QBST gentle": replace(DGCNN, method="qbst", preset="gentle", warm_up="DGCNN S+C+M"),
    # Switches of the way into the network and of the augmentation, one at a time, on scans alone.
    "no size": replace(SCANS, preparation=ROBUST),
    "strays kept": replace(SCANS, preparation=replace(SIZED, remove_outliers=False)),
    "unit ball": replace(SCANS, preparation=replace(SIZED, radius_share=1.0)),
    "same points": replace(SCANS, preparation=replace(SIZED, redraw=False)),
    "paper's way": replace(SCANS, preparation=PAPER, augmentation=Augmentation()),
    "aligned": replace(SCANS, preparation=replace(SIZED, align=True)),
    "sight": replace(SCANS, augmentation=SEEN),
    "no augmentation": replace(SCANS, augmentation=Augmentation()),
    "more cuts": replace(SCANS, augmentation=CUT),
    "M sight": replace(ALL, cloud="surface", augmentation=SEEN),
}


def parts(shared: Path) -> dict[str, PointClouds]:
    """NYU's strict objects, of the first 70 % of the frames and of the others, and SUN RGB-D's."""
    path, other = shared / "nyuv2_objects.npz", shared / "sunrgbd_objects.npz"
    split = {name: f"strict-{name}" for name in ("dev", "check")}
    named = {
        name: load_clouds(path, split=part, num_points=None, class_names=POINTDA10)
        for name, part in split.items()
    }
    return named | {"sunrgbd": load_clouds(other, num_points=1024, class_names=POINTDA10)}


def settings_of(cell: Cell, clouds: int, seed: int) -> TrainSettings:
    """How a cell is trained on a source of so many clouds."""
    held = 0.1
    batches = -(-int(clouds * (1 - held)) // BATCH)
    train = TrainSettings(
        model=cell.network,
        model_settings=FAST if cell.network == "pointnet" else {},
        num_points=256,
        epochs=max(1, round(cell.steps / batches)),
        batch_size=BATCH,
        label_smoothing=0.1,
        holdout=held,
        validate_every=0,
        preparation=cell.preparation,
        augmentation=cell.augmentation,
        seed=seed,
        threads=1,
    )
    return replace(train, **cell.train)


def bootstrap_difference(
    first_right: Bool[np.ndarray, "s b"],
    second_right: Bool[np.ndarray, "s b"],
    groups: Int[np.ndarray, "b"],
    draws: int = 10_000,
) -> SeedComparison:
    """Compare two methods on the same clouds and seeds; the interval covers the choice of both.

    Seeds, and groups of related clouds, such as those of one room, are drawn with replacement and
    independently (the pigeonhole bootstrap of Owen, Annals of Applied Statistics 2007, which errs
    on the wide side). With one seed the interval covers the clouds alone.
    """
    difference = first_right.astype(float) - second_right
    names, member = np.unique(groups, return_inverse=True)
    sums = np.stack([np.bincount(member, row, len(names)) for row in difference])
    sizes = np.bincount(member, minlength=len(names))
    seeds = len(difference)
    seed_weights, group_weights = drawn_weights(seeds, len(names), draws)
    means = np.einsum("ds,sg,dg->d", seed_weights, sums, group_weights) / (group_weights @ sizes)
    low, high = np.quantile(means, [0.025, 0.975])
    return SeedComparison(float(difference.mean()), (float(low), float(high)), seeds)


@functools.lru_cache(maxsize=4)  # the same for all pairs of a table; draws take most of the time
def drawn_weights(
    seeds: int, groups: int, draws: int
) -> tuple[Float[np.ndarray, "d s"], Int[np.ndarray, "d g"]]:
    """Draw seeds and groups with replacement: the share of each seed, how often each group."""
    rng = np.random.default_rng(0)
    seed_weights = rng.multinomial(seeds, np.full(seeds, 1 / seeds), draws) / seeds
    return seed_weights, rng.multinomial(groups, np.full(groups, 1 / groups), draws)


def make(options: argparse.Namespace, name: str, seed: int) -> None:
    """Train one cell with one seed and score it."""
    cell, clouds = CELLS[name], parts(options.shared)
    dev = clouds["dev"]
    target = UnlabelledClouds(dev.points, dev.ids, origin=dev.origin)
    source = load_clouds(options.source, cloud=cell.cloud, num_points=None)
    train = settings_of(cell, len(source), seed)
    needs = cell.method != "source-only"
    rounds = None
    if cell.rounds or cell.method in ("qbst", "spst"):
        rounds = replace(PRESETS[cell.preset], **{"rule": cell.method, **cell.rounds})
    run = options.out / f"{name}-{seed}"
    fit(
        cell.method,
        source,
        target if needs else None,
        train,
        rounds,
        run_dir=run,
        warm_up=options.out / f"{cell.warm_up}-{seed}" if cell.warm_up else None,
    )
    # How well the source was learnt, by its own labels: 500 clouds, of which a tenth was held out.
    rows = np.random.default_rng(0).permutation(len(source))[:500]
    clouds["source"] = source.select(np.sort(rows))
    for part in ("source", *scored(options)):
        fields = {"cell": name, "part": part}
        record = evaluate(run, clouds[part], experiment=fields)
        append_record(options.records / RECORDS, record)


def scored(options: argparse.Namespace) -> tuple[str, ...]:
    return ("dev", "sunrgbd", "check") if options.check else ("dev", "sunrgbd")


def recorded(folder: Path, *named: str) -> dict[tuple[Any, ...], RunRecord]:
    """Return records by these fields of theirs (by default the cell), seed and part."""
    if not (folder / RECORDS).is_file():
        return {}
    records, faults = read_records(folder / RECORDS)
    if faults:
        raise SystemExit("\n".join(faults))
    key = operator.itemgetter(*(named or ("cell",)), "seed", "part")
    return {
        key({**one.experiment, "seed": one.seed}): one
        for _, one in records
        if one.experiment is not None
    }


def call(words: list[str], name: str, seed: int) -> tuple[str, int, float, int]:
    start = time.perf_counter()
    alone = os.environ | {"OMP_NUM_THREADS": "1", "TQDM_DISABLE": "1"}
    code = subprocess.run(
        [sys.executable, __file__, *words, "--one", name, "--seeds", str(seed)], env=alone
    ).returncode
    return name, seed, time.perf_counter() - start, code


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--source", type=Path, required=True)
    parser.add_argument("--shared", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--records", type=Path, default=Path("results/real"))
    parser.add_argument("--cells", nargs="+", default=list(CELLS), choices=list(CELLS))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--check", action="store_true", help="score the last 30 % too")
    parser.add_argument("--one", help=argparse.SUPPRESS)
    parser.add_argument("--dry-run", action="store_true")
    options = parser.parse_args()
    if options.one:
        make(options, options.one, options.seeds[0])
        return 0
    there = recorded(options.records)
    left = [
        (name, seed)
        for seed in options.seeds
        for name in options.cells
        if not all((name, seed, part) in there for part in scored(options))
    ]
    print(f"{len(left)} runs are missing: {', '.join(f'{n}-{s}' for n, s in left)}", flush=True)
    if options.dry_run:
        return 0
    words = []
    for name in ("source", "shared", "out", "records"):
        words += [f"--{name}", str(getattr(options, name))]
    words += ["--check"] if options.check else []
    worst = 0
    # What starts from a warm-up comes after all warm-ups; GAST serves as such too.
    first = [item for item in left if not CELLS[item[0]].warm_up]
    with concurrent.futures.ThreadPoolExecutor(options.workers) as pool:
        for batch in (first, [item for item in left if item not in first]):
            for job in concurrent.futures.as_completed(
                [pool.submit(call, words, *item) for item in batch]
            ):
                name, seed, seconds, code = job.result()
                worst = max(worst, code)
                score = ""
                if code == 0:
                    scores = recorded(options.records)[name, seed, "dev"].scores
                    both = (scores.accuracy, scores.class_mean_accuracy)
                    score = " / ".join(f"{100 * x:.1f}" for x in both)
                print(f"{name}-{seed}: {seconds / 60:.1f} min, code {code}; {score}", flush=True)
    return worst


if __name__ == "__main__":
    sys.exit(main())
