"""Twelve real machine parts: forests trained on scans of their CAD, scored on 78 real clouds.

Run: python benchmarks/parts.py --shared DIR --out out/parts [--results results/parts]

DIR holds ``parts/`` of the shared data. Writes ``parts.md`` and, cloud by cloud, ``answers.csv``.
The real clouds lie in their principal axes and their up is unknown, so every source is turned the
same way. Intervals: 95 %, paired over clouds and seeds. Scans and fits are kept in --out.
"""

import argparse
import csv
import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

os.environ["OMP_NUM_THREADS"] = "1"  # before anything counts the cores

import numpy as np
from qs3.forest.fit import PartModel, fit_part
from qs3.forest.parts import CANDIDATES, RESIDUAL
from real import bootstrap_difference
from scipy.stats import rankdata
from sklearn.metrics import roc_auc_score
from tqdm import tqdm

from qs3.evaluation.metrics import class_mean_accuracy
from qs3.files import write_text
from qs3.forest import describe, describe_varied, fit_forest
from qs3.io.clouds import CloudKind, PointClouds
from qs3.io.layouts.store import read_ragged
from qs3.io.preparation import LARGEST, ROBUST, stack
from qs3.meshes import load_mesh
from qs3.training import TrainSettings, fit
from qs3.training.loaded import counting, distinct
from qs3.training.trained import load_trained

KINDS: dict[str, CloudKind] = {"M": "surface", "C": "clean", "S": "points"}
SOURCES = {"M": "M", "C": "C", "S": "S", "S+C": "SC", "S+C+M": "SCM"}
STEPS, UNIT, NETWORK_SEEDS = 600, 0.05, 1
"""Optimiser steps of a network, the metres that become 1 for it, and its seeds."""
SEEDS, DRAWS, WEIGHT, LABELS = 3, 8, 10.0, (1, 3, 5)
MILLIMETRE = 1e-3
OPTIONS = (
    "--object-size file --units mm --pose resting --scene table --crop mask --views 1 "
    "--scans-per-mesh 20 --seed 0 --sampling random --num-points 4096"
)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--shared", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--results", type=Path, default=Path("results/parts"))
    options = parser.parse_args()
    benchmark = Benchmark(options.shared / "parts", options.out)
    lines = benchmark.sources() + benchmark.networks() + benchmark.fits() + benchmark.few_labels()
    table = ["| learner | source | right % | class mean % | difference |", "|---|---|---|---|---|"]
    unknown = benchmark.unknown()
    options.results.mkdir(parents=True, exist_ok=True)
    write_text(options.results / "parts.md", "\n".join([*table, *lines, "", *unknown, ""]))
    with (options.results / "answers.csv").open("w", encoding="utf-8", newline="") as file:
        csv.writer(file).writerows(benchmark.answers)
    print("\n".join([*table, *lines, "", *unknown]))


class Benchmark:
    """Descriptors of sources and of real clouds, and what was answered so far."""

    def __init__(self, shared: Path, out: Path) -> None:
        real = np.load(shared / "atwork_dev.npz")
        self.clouds = np.split(real["points"].astype(np.float64), real["offset"][1:-1])
        self.labels = real["label"].astype(np.int64)
        self.names = tuple(str(name) for name in real["class_names"])
        self.models = [
            PartModel.of_mesh(load_mesh(shared / "cad" / f"{name}.stl"), MILLIMETRE)
            for name in self.names
        ]
        self.out, source = out, scan(shared, out)
        self.varied = described(self.clouds)
        self.target = self.varied[0]
        self.turned, self.features, self.classes = {}, {}, np.empty(0, dtype=np.int64)
        for letter, kind in KINDS.items():
            found = read_ragged(source, kind)
            assert found.labels is not None and found.class_names == self.names
            clouds = [principal(np.unique(cloud, axis=0)) for cloud in found.clouds]
            self.turned[letter], self.features[letter] = clouds, described(clouds)
            self.classes = np.asarray(found.labels, dtype=np.int64)
        self.right: dict[str, np.ndarray] = {}
        self.answers: list[list[object]] = [
            ["learner", "seed", *map(str, real["name"])],
            ["label", "", *self.labels.tolist()],
        ]

    def train(self, letters: str, seed: int, left_out: int | None = None) -> np.ndarray:
        """Return the probabilities of the real clouds by a forest; a class may be left out."""
        features = np.concatenate([self.features[letter] for letter in letters], axis=1)
        labels = np.tile(self.classes, len(letters))
        names = list(self.names)
        if left_out is not None:
            features, labels = features[:, labels != left_out], labels[labels != left_out]
            labels = labels - (labels > left_out)
            del names[left_out]
        forest = fit_forest(features, labels, tuple(names), seed=seed)
        found = forest.predict_proba(self.target)
        return found if left_out is None else np.insert(found, left_out, 0.0, axis=1)

    def row(self, learner: str, source: str, answers: np.ndarray, against: str = "") -> str:
        """Keep the answers of all seeds, and return their line of the table."""
        name, right = f"{learner} {source}", answers == self.labels
        self.right[name] = right
        self.answers += [[name, seed, *row] for seed, row in enumerate(answers.tolist())]
        means = [class_mean_accuracy(self.labels, row, len(self.names)) for row in answers]
        scores = f"{100 * right.mean():.1f} | {100 * np.mean(means):.1f}"
        if not against:
            return f"| {learner} | {source} | {scores} | – |"
        clouds = np.arange(len(self.labels))
        difference = bootstrap_difference(right, self.right[against][: len(right)], clouds)
        return f"| {learner} | {source} | {scores} | to {against}: {difference.format()} |"

    def sources(self) -> list[str]:
        """Compare sources by a forest each."""
        self.found = {
            name: np.stack([self.train(letters, seed) for seed in range(SEEDS)])
            for name, letters in SOURCES.items()
        }
        against = {"C": "forest M", "S": "forest C", "S+C": "forest S", "S+C+M": "forest S"}
        return [
            self.row("forest", name, found.argmax(axis=2), against.get(name, ""))
            for name, found in self.found.items()
        ]

    def networks(self) -> list[str]:
        """Train a PointNet on each source; clouds keep their metric size."""
        lines = []
        for name, letters in SOURCES.items():
            if name == "S+C":
                continue
            answers = [self.train_network(letters, seed) for seed in range(NETWORK_SEEDS)]
            answers = np.stack(answers)
            lines.append(self.row("PointNet", name, answers, f"forest {name}"))
        return lines

    def train_network(self, letters: str, seed: int) -> np.ndarray:
        """Return the answers of a PointNet; a run that is there already is not made again."""
        clouds = [cloud for letter in letters for cloud in self.turned[letter]]
        labels = np.tile(self.classes, len(letters))
        ids = tuple(map(str, range(len(clouds))))
        source = PointClouds(stack(clouds, None, "source", LARGEST), labels, self.names, ids)
        settings = TrainSettings(
            model="pointnet",
            model_settings={"transforms": False},
            num_points=256,
            epochs=round(STEPS / np.ceil(len(clouds) / 32)),
            holdout=0.0,
            validate_every=0,
            label_smoothing=0.1,
            preparation=replace(ROBUST, metric_unit=UNIT, align=True),
            seed=seed,
            threads=1,
        )
        run = self.out / f"pointnet-{letters}-{seed}"
        fit("source-only", source, None, settings, run_dir=run)
        shares = load_trained(run).ask(stack(self.clouds, None, "target", LARGEST)).probabilities
        return shares.argmax(axis=1)

    def fits(self) -> list[str]:
        """Let the residual of the likeliest parts join the decision."""
        path = self.out / "residuals.npy"
        if not path.is_file():
            distinct = [np.unique(cloud, axis=0) for cloud in self.clouds]
            fits = [
                [fit_part(cloud, model).residual for model in self.models]
                for cloud in tqdm(distinct, "fits", unit="cloud")
            ]
            np.save(path, fits)
        self.residuals = np.load(path)
        lines = [self.row("fit alone", "CAD", self.residuals.argmin(axis=1)[None])]
        for name in ("S", "S+C+M"):
            found = self.found[name]
            least = np.sort(found, axis=2)[..., -CANDIDATES, None]
            score = np.log(found + 1e-12) - RESIDUAL * self.residuals
            answers = np.where(found >= least, score, -np.inf).argmax(axis=2)
            lines.append(self.row("forest + fit", name, answers, f"forest {name}"))
        return lines

    def few_labels(self) -> list[str]:
        """Add labelled clouds to S+C+M; all numbers of labels are scored on the same clouds."""
        features = np.concatenate([*self.features.values()], axis=1)
        classes, lines = np.tile(self.classes, len(KINDS)), []
        plain = self.found["S+C+M"][0].argmax(axis=1)
        for number in LABELS:
            scores = []
            for draw in range(DRAWS):
                rng, known, scored = np.random.default_rng(draw), [], []
                for k in range(len(self.names)):
                    own = rng.permutation(np.flatnonzero(self.labels == k))
                    most = min(LABELS[-1], len(own) - 1)  # one is left to score
                    known.extend(own[: min(number, most)])
                    scored.extend(own[most:])
                forest = fit_forest(
                    np.concatenate([features, self.varied[:, known]], axis=1),
                    np.concatenate([classes, self.labels[known]]),
                    self.names,
                    np.repeat([1.0, WEIGHT * len(KINDS)], [len(classes), len(known)]),
                    seed=draw,
                )
                answers = forest.predict_proba(self.target[scored]).argmax(axis=1)
                labels = self.labels[scored]
                mean = class_mean_accuracy(labels, answers, len(self.names))
                before = (plain[scored] == labels).mean()
                scores.append([(answers == labels).mean(), mean, before])
            right, mean, before = 100 * np.mean(scores, axis=0)
            lines.append(
                f"| forest, labels a class: {number} | S+C+M | {right:.1f} | {mean:.1f} | "
                f"to forest S+C+M on the same clouds: {right - before:+.1f} points |"
            )
        return lines

    def unknown(self) -> list[str]:
        """Leave each part out in turn; how well do three scores tell its clouds from the others?"""
        areas = []
        for k in range(len(self.names)):
            found = self.train("SCM", 0, left_out=k)
            entropy = -(found * np.log(found + 1e-12)).sum(axis=1)
            likeliest = np.argsort(found, axis=1)[:, -CANDIDATES:]
            residual = np.take_along_axis(self.residuals, likeliest, axis=1).min(axis=1)
            both = rankdata(entropy) + rankdata(residual)
            scores = entropy, 1 - found.max(axis=1), residual, both
            areas.append([roc_auc_score(self.labels == k, score) for score in scores])
        columns = "entropy (--unknown)", "1 − largest probability", "fit residual", "ranks, 1 + 3"
        lines = [f"| part left out | {' | '.join(columns)} |", "|---|---|---|---|---|"]
        for name, row in zip((*self.names, "mean"), (*areas, np.mean(areas, axis=0)), strict=True):
            lines.append(f"| {name} | " + " | ".join(f"{area:.2f}" for area in row) + " |")
        return lines


def described(clouds: Sequence[np.ndarray]) -> np.ndarray:
    """Return the descriptors of clouds and of their copies, as a forest is trained on them."""
    varied = describe_varied([distinct(cloud) for cloud in clouds])
    varied[0] = describe([counting(cloud) for cloud in clouds])
    return varied


def scan(shared: Path, out: Path) -> Path:
    """Scan the parts as the camera of the real clouds may have; returns the data set's folder."""
    for path in sorted((shared / "cad").glob("*.stl")):
        (out / "cad" / path.stem).mkdir(parents=True, exist_ok=True)
        shutil.copy(path, out / "cad" / path.stem)
    source = out / "source"
    if (source / "dataset.json").is_file():
        return source
    command = f"-m qs3 generate --meshes {out / 'cad'} --sensor {shared / 'xtion.toml'} {OPTIONS}"
    subprocess.run([sys.executable, *command.split(), "--out", str(source)], check=True)
    return source


def principal(cloud: np.ndarray) -> np.ndarray:
    """Centre a cloud and turn it into its principal axes, by falling variance.

    The farthest point on each axis is positive.
    """
    cloud = cloud - cloud.mean(axis=0)
    cloud = cloud @ np.linalg.eigh(np.cov(cloud.T))[1][:, ::-1]
    farthest = cloud[np.abs(cloud).argmax(axis=0), range(3)]
    return cloud * np.where(farthest < 0, -1.0, 1.0)


if __name__ == "__main__":
    main()
