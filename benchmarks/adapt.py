"""CPU seconds of ``qs3 adapt`` on twelve real machine parts, and how far its confidence is right.

Run: python benchmarks/adapt.py --shared DIR --out out/adapt [--against CHECKOUT] [--workers N]

120 simulated scans, 78 real clouds (``parts/`` of the shared data). The first call does everything;
the second finds the simulated scans and no run; the third finds all. ``--against`` measures an
older checkout in the same run (``git archive COMMIT src | tar -x -C CHECKOUT``). Labels of the
clouds serve the score alone. A line that is in --out is not measured again.
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

from qs3.clouds.ply_writer import ply_bytes
from qs3.files import write_bytes, write_text

HERE = Path(__file__).parents[1]
BINS = 10


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--shared", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--against", type=Path)
    parser.add_argument("--workers", type=int, help="processes that scan; default: all cores")
    given = parser.parse_args()
    if given.against is not None and not (given.against / "src" / "qs3").is_dir():
        parser.error(f"{given.against}: holds no src/qs3")
    real = np.load(given.shared / "parts" / "atwork_dev.npz")
    truth = {}
    clouds = np.split(real["points"].astype(np.float32), real["offset"][1:-1])
    for row, (cloud, label) in enumerate(zip(clouds, real["label"].tolist(), strict=True)):
        file = given.out / "scans" / f"{row:03d}.ply"
        write_bytes(file, ply_bytes(cloud))
        truth[str(file)] = str(real["class_names"][label])
    lines = [
        "| checkout | all, CPU s | without scans | again | right % | ECE | expected of 78 |",
        "|---|---|---|---|---|---|---|",
    ]
    for name, checkout in (("before", given.against), ("after", HERE)):
        if checkout is None:
            continue
        record = given.out / f"{name}.md"
        if not record.is_file():
            words = ("--workers", given.workers) if given.workers is not None else ()
            place, parts = given.out / name, given.shared / "parts"
            write_text(record, measure(checkout.resolve(), parts, place, truth, words))
        lines.append(record.read_text(encoding="utf-8"))
    write_text(given.out / "results" / "adapt.md", "\n".join([*lines, ""]))
    print("\n".join(lines))


def measure(
    checkout: Path, parts: Path, place: Path, truth: dict[str, str], more: tuple[object, ...]
) -> str:
    """Return the line of one checkout: CPU seconds of three calls, and its answers' scores."""
    shutil.rmtree(place, ignore_errors=True)
    words = [parts / "cad", place.parent / "scans", "--camera", parts / "xtion.toml"]
    words += ["--units", "mm", *more]
    seconds = [run(checkout, *words, "--out", place)]
    shutil.rmtree(place / "run")
    seconds += [run(checkout, *words, "--out", place) for _ in range(2)]
    with (place / "answers.csv").open(encoding="utf-8", newline="") as file:
        rows = [(row["class"] == truth[row["file"]], float(row["confidence"] or 0))
                for row in csv.DictReader(file)]  # fmt: skip
    right, share = (np.array(column, dtype=np.float64) for column in zip(*rows, strict=True))
    cells = [f"{value:.1f}" for value in (*seconds, 100 * right.mean())]
    return " | ".join(
        [f"| {place.name}", *cells, f"{error(right, share):.3f}", f"{chance(share):.3f} |"]
    )


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
    done = subprocess.run(command, capture_output=True, text=True, env=environment)
    if done.returncode:
        raise SystemExit(f"{' '.join(command)}\n{done.stderr}")
    after = resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


if __name__ == "__main__":
    main()
