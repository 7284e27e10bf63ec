"""What benches share: arguments, the real parts, a pinhole camera, tables, how CAD is weighed."""

import argparse
import csv
import os
from collections.abc import Callable, Sequence
from pathlib import Path

os.environ["OMP_NUM_THREADS"] = "1"  # before anything counts the cores

import numpy as np

from qs3.files import write_text
from qs3.parts import Forest
from qs3.parts.forest_and_cad import LEAST_MISFIT, Fusion, Judged, measure_fusion
from qs3.parts.witness import SEARCHED

FOLDS = 3
"""Of forests that hold simulated scans out."""


def arguments(text: str | None, *paths: str, seeds: Sequence[int] = ()) -> argparse.ArgumentParser:
    """Return a parser of paths that are needed, such as --out, of --results, and of seeds."""
    parser = argparse.ArgumentParser(description=text)
    for name in paths:
        parser.add_argument(f"--{name}", type=Path, required=True)
    parser.add_argument("--results", type=Path)
    if seeds:
        parser.add_argument("--seeds", type=int, nargs="+", default=[*seeds])
    return parser


def keep(
    options: argparse.Namespace, name: str, lines: Sequence[str], answers: Sequence = ()
) -> None:
    """Print a table; write it, and the answers it is of, into --results or results/ in --out."""
    folder = options.results or options.out / "results"
    write_text(folder / f"{name}.md", "\n".join([*lines, ""]))
    if answers:
        with (folder / "answers.csv").open("w", encoding="utf-8", newline="") as file:
            csv.writer(file).writerows(answers)
    print("\n".join(lines))


def real_parts(shared: Path) -> tuple[list[np.ndarray], np.ndarray, tuple[str, ...], list[str]]:
    """Return clouds of twelve real parts, their labels, the classes, and names of the clouds."""
    real = np.load(shared / "parts" / "atwork_dev.npz")
    clouds = np.split(real["points"].astype(np.float64), real["offset"][1:-1])
    classes = tuple(map(str, real["class_names"]))
    return clouds, real["label"].astype(np.int64), classes, [*map(str, real["name"])]


def rays_of(width: int, height: int, focal: float) -> np.ndarray:
    """Return the direction of each pixel, row by row, with depth 1."""
    v, u = np.indices((height, width)).reshape(2, -1)
    return np.stack([(u - (width - 1) / 2) / focal, (v - (height - 1) / 2) / focal, u * 0 + 1], 1)


def camera_of(width: int, height: int, focal: float) -> dict:
    """Return what a file says of that camera, whose depth is in tenths of a millimetre."""
    matrix = [focal, 0, (width - 1) / 2, 0, focal, (height - 1) / 2, 0, 0, 1]
    return {"cam_K": matrix, "depth_scale": 0.1, "width": width, "height": height}


def held_out(
    fit: Callable[[np.ndarray], Forest], rows: np.ndarray, classes: np.ndarray, seed: int
) -> np.ndarray:
    """Return the probabilities of scans by forests that did not learn from them.

    ``fit`` gets a mask of the scans to learn from; ``rows`` are the descriptors of all.
    """
    fold = np.empty(len(classes), np.int64)
    for k in range(classes.max() + 1):
        members = np.flatnonzero(classes == k)
        fold[np.random.default_rng([seed, k]).permutation(members)] = (
            np.arange(len(members)) % FOLDS
        )
    found = np.empty((len(classes), classes.max() + 1))
    for number in range(FOLDS):
        found[fold == number] = fit(fold != number).predict_proba(rows[fold == number])
    return found


def searched(shares: np.ndarray, seen: np.ndarray) -> np.ndarray:
    """Return how well the CAD of the likeliest classes agrees; NaN for the others.

    The disagreement heeds how much better others of these agree (`Candidate.beaten`).
    """
    rank = np.argsort(np.argsort(-shares, axis=1), axis=1)
    seen = np.where(((rank < SEARCHED) | (shares > 0.01))[:, :, None], seen, np.nan)
    misfit = np.maximum(seen[:, :, 0], LEAST_MISFIT)
    least = np.fmin.reduce(misfit, axis=1, keepdims=True)
    seen[:, :, 3] *= np.fmax(1, misfit / least) ** 2
    return seen


def weighed(
    names: tuple[str, ...],
    labels: np.ndarray,
    clouds: Sequence[np.ndarray],
    shares: np.ndarray,
    compared: np.ndarray,
    posed: np.ndarray | None = None,
) -> Fusion:
    """Weigh a forest, whose probabilities of scans are ``shares``, against their CAD.

    ``posed`` marks the scans whose pose is right; by default all are.
    """
    seen, points = searched(shares, compared), np.array([len(cloud) for cloud in clouds])
    off = np.nan_to_num(seen[:, :, 3], nan=np.inf)
    half, posed = np.full(len(labels), 0.5), labels >= 0 if posed is None else posed
    return measure_fusion(Judged(names, labels, points, shares, half, seen[:, :, :3], off, posed))
