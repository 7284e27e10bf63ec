"""CPU seconds of ``qs3 adapt`` on twelve real machine parts, and how far its confidence is right.

Run: python benchmarks/adapt.py --shared DIR --out out/adapt [--against CHECKOUT]

120 simulated scans, 78 real clouds (``parts/`` of the shared data). The first call does everything;
the second finds the simulated scans and no run; the third finds all. ``--against`` measures an
older checkout in the same run. Labels of the clouds serve the score alone.
"""

import argparse
import csv
import os
import resource
import shutil
import subprocess
import sys
from pathlib import Path

import numpy as np

from qs3.files import write_bytes
from qs3.io.ply import ply_bytes

HERE = Path(__file__).parents[1]
BINS = 10


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--shared", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--against", type=Path)
    given = parser.parse_args()
    real = np.load(given.shared / "parts" / "atwork_dev.npz")
    truth = {}
    clouds = np.split(real["points"].astype(np.float32), real["offset"][1:-1])
    for row, (cloud, label) in enumerate(zip(clouds, real["label"].tolist(), strict=True)):
        file = given.out / "scans" / f"{row:03d}.ply"
        write_bytes(file, ply_bytes(cloud))
        truth[str(file)] = str(real["class_names"][label])
    print("| checkout | all | without scans | again | right % | ECE | expected of 78 |")
    print("|---|---|---|---|---|---|---|")
    for checkout in filter(None, (given.against, HERE)):
        print(measure(checkout, given.shared / "parts", given.out, truth))


def measure(checkout: Path, parts: Path, out: Path, truth: dict[str, str]) -> str:
    """Return the line of one checkout: CPU seconds of three calls, and its answers' scores."""
    name = "before" if checkout != HERE else "after"
    place = out / name
    shutil.rmtree(place, ignore_errors=True)
    words = [parts / "cad", out / "scans", "--camera", parts / "xtion.toml", "--units", "mm"]
    seconds = [run(checkout, *words, "--out", place)]
    shutil.rmtree(place / "run")
    seconds += [run(checkout, *words, "--out", place) for _ in range(2)]
    with (place / "answers.csv").open(encoding="utf-8", newline="") as file:
        rows = [(row["class"] == truth[row["file"]], float(row["confidence"]))
                for row in csv.DictReader(file)]  # fmt: skip
    right, share = (np.array(column, dtype=np.float64) for column in zip(*rows, strict=True))
    cells = [f"{value:.1f}" for value in (*seconds, 100 * right.mean())]
    return " | ".join([f"| {name}", *cells, f"{error(right, share):.3f}", f"{chance(share):.3f} |"])


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
    """Run ``qs3 adapt`` of a checkout; return the CPU seconds of all its processes."""
    before = resource.getrusage(resource.RUSAGE_CHILDREN)
    environment = os.environ | {"PYTHONPATH": str(checkout / "src")}
    command = [sys.executable, "-m", "qs3", "adapt", *map(str, words)]
    subprocess.run(command, check=True, capture_output=True, env=environment)
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


if __name__ == "__main__":
    main()
