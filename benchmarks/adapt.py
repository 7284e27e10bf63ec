"""``qs3 adapt`` on twelve real machine parts: right answers, confidence, and CPU seconds.

Run: python benchmarks/adapt.py --shared DIR --out out/adapt [--seeds 0 1 2] [--against CHECKOUT]

120 simulated scans of each seed, 78 real clouds (``parts/`` of the shared data), of which labels
serve the score alone. Simulated clouds that a run is scored on are those that another seed has
learnt from. ``adapt.md`` has a line per seed; ``reliability.md`` has the answers of all seeds by
their confidence. ``--against`` measures CPU seconds alone, of an older checkout in the same run
(``git archive COMMIT src | tar -x -C CHECKOUT``): of a call that does everything, of one that finds
the simulated scans and no run, and of one that finds all. What is in --out is not made again.
"""

import argparse
import csv
import os
import resource
import shutil
import subprocess
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
from common import arguments, keep, real_parts

from qs3.clouds.ply_writer import ply_bytes
from qs3.files import write_bytes

HERE = Path(__file__).parents[1]
BINS = 10
CONFIDENCE = (0.0, 0.5, 0.7, 0.9, 0.99)
"""Where the rows of ``reliability.md`` begin."""
Scored = tuple[np.ndarray, ...]
"""As `scored` returns it."""


def main() -> None:
    parser = arguments(__doc__, "shared", "out", seeds=(0, 1, 2))
    parser.add_argument("--against", type=Path)
    options = parser.parse_args()
    clouds, labels, classes, _ = real_parts(options.shared)
    scans, parts = options.out / "scans", options.shared / "parts"
    truth = {}
    for row, (cloud, label) in enumerate(zip(clouds, labels.tolist(), strict=True)):
        file = scans / f"{row:03d}.ply"
        write_bytes(file, ply_bytes(cloud.astype(np.float32)))
        truth[str(file)] = classes[label]
    words = [parts / "cad", scans, "--camera", parts / "xtion.toml", "--units", "mm"]
    if options.against is not None:
        compare(options, words)
        return
    runs, real, simulated = {s: options.out / f"seed-{s}" for s in options.seeds}, {}, {}
    for seed, place in runs.items():
        run(HERE, "adapt", *words, "--seed", seed, "--out", place)
        real[seed] = scored(place / "answers.csv", truth)
        clouds_of = options.out / f"simulated-{seed}"
        if not clouds_of.is_dir():
            run(HERE, "convert", place / "source", clouds_of, "--to", "ply")
    for seed, other in zip(runs, [*[*runs][1:], *[*runs][:1]], strict=True):
        table, of = options.out / f"simulated-{seed}.csv", options.out / f"simulated-{other}"
        if seed != other:
            run(HERE, "predict", runs[seed] / "run", of, "--csv", table)
            truth |= {str(path): path.parent.name for path in of.rglob("*.ply")}
            simulated[seed] = scored(table, truth)
    keep(options, "adapt", by_seed(real))
    keep(options, "reliability", by_confidence(real, simulated))


def by_seed(real: Mapping[int, Scored]) -> list[str]:
    """Return the lines of ``adapt.md``."""
    lines = ["| seed | right % | class mean % | right ones lost % | wrong ones lost % | expected "
             "calibration error | of 78 that are calibrated exactly |",
             "|---|---|---|---|---|---|---|"]  # fmt: skip
    for seed, (right, share, lost, known) in real.items():
        mean = np.mean([right[known == k].mean() for k in np.unique(known)])
        cells = [f"{100 * value:.1f}" for value in (right.mean(), mean)]
        cells += [f"{100 * lost[some].mean():.0f}" for some in (right, ~right)]
        cells += [f"{value:.3f}" for value in (error(right, share), chance(share))]
        lines.append(" | ".join([f"| {seed}", *cells]) + " |")
    return lines


def by_confidence(*sides: Mapping[int, Scored]) -> list[str]:
    """Return the lines of ``reliability.md``, of real clouds and of simulated ones."""
    lines = ["| confidence | real clouds | mean confidence % | right % | simulated clouds | mean "
             "confidence % | right % |", "|---|---|---|---|---|---|---|"]  # fmt: skip
    for low, high in zip(CONFIDENCE, (*CONFIDENCE[1:], 1.01), strict=True):
        cells = [f"| {low:g} to {min(high, 1):g}"]
        for side in sides:
            right, share = (np.concatenate([rows[i] for rows in side.values()]) for i in (0, 1))
            some = (share >= low) & (share < high)
            cells += [str(some.sum())]
            cells += [f"{100 * values[some].mean():.0f}" if some.any() else "–"
                      for values in (share, right)]  # fmt: skip
        lines.append(" | ".join(cells) + " |")
    return lines


def scored(table: Path, truth: dict[str, str]) -> Scored:
    """Return of each answer whether it is right, its confidence, whether lost, and its label."""
    names = sorted({*truth.values()})
    with table.open(encoding="utf-8", newline="") as file:
        rows = [(row["class"] == truth[row["file"]], float(row["confidence"] or 0),
                 row["lost"] == "true", names.index(truth[row["file"]]))
                for row in csv.DictReader(file)]  # fmt: skip
    return tuple(np.array(column) for column in zip(*rows, strict=True))


def compare(options: argparse.Namespace, words: Sequence[object]) -> None:
    """Write the CPU seconds of three calls of an older checkout, and of this one."""
    lines = ["| checkout | all, CPU s | without scans | again |", "|---|---|---|---|"]
    for name, checkout in (("before", options.against), ("after", HERE)):
        place = options.out / name
        shutil.rmtree(place, ignore_errors=True)
        seconds = [run(checkout.resolve(), "adapt", *words, "--out", place)]
        shutil.rmtree(place / "run")
        seconds += [run(checkout.resolve(), "adapt", *words, "--out", place) for _ in range(2)]
        lines.append(" | ".join([f"| {name}", *(f"{value:.1f}" for value in seconds)]) + " |")
    keep(options, "times", lines)


def error(right: np.ndarray, share: np.ndarray) -> float:
    """Return the expected calibration error in ten bins."""
    place = np.minimum((share * BINS).astype(int), BINS - 1)
    off = [abs((right - share)[place == i].sum()) for i in range(BINS)]
    return float(sum(off) / len(right))


def chance(share: np.ndarray) -> float:
    """Return the mean error of so few answers that are calibrated exactly."""
    rng = np.random.default_rng(0)
    return float(np.mean([error(rng.random(len(share)) < share, share) for _ in range(500)]))


def run(checkout: Path, *words: object) -> float:
    """Run a verb of a checkout; return the CPU seconds of all its processes."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    environment = os.environ | {"PYTHONPATH": str(checkout / "src")}
    command = [sys.executable, "-m", "qs3", *map(str, words)]
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    if done.returncode:
        raise SystemExit(f"{' '.join(command)}\n{done.stderr}")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


if __name__ == "__main__":
    main()
