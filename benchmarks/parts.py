"""Twelve real machine parts: forests trained on scans of their CAD, scored on 78 real clouds.

Run: python benchmarks/parts.py --shared DIR --out out/parts [--seeds 0 1 2] [--workers N]

DIR holds ``parts/`` of the shared data. Writes ``parts.md`` and, cloud by cloud, ``answers.csv``
into --results, by default results/ in --out. Each seed has scans of its own, and its forest's. The
real clouds lie in their principal axes and their up is unknown, so every source is turned the same
way. They lie on a grid of 2.5 mm; with ``--grid 0.0025`` so do the scans, which need another --out.
Intervals: 95 %, paired over clouds and seeds. What is in --out is not made again.
"""

import argparse
import os
import shutil
import subprocess
import sys
from collections.abc import Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from functools import partial
from multiprocessing import get_context
from pathlib import Path

import numpy as np
from common import arguments, held_out, keep, real_parts, searched, weighed
from real import bootstrap_difference
from scipy.stats import rankdata
from sklearn.metrics import roc_auc_score
from tqdm import tqdm

from qs3.answers.answer import load_trained
from qs3.clouds.layouts.store import read_ragged
from qs3.clouds.preparation import LARGEST, ROBUST, stack
from qs3.clouds.types import CloudKind, PointClouds
from qs3.evaluation.metrics import class_mean_accuracy
from qs3.parts import Forest, describe_varied, fit_forest, locate
from qs3.parts.cad import is_posed
from qs3.parts.library import Library
from qs3.parts.loaded_forest import cleaned
from qs3.parts.locating import Candidate
from qs3.parts.witness import Seen
from qs3.runs import TrainSettings
from qs3.training import fit

KINDS: dict[str, CloudKind] = {"M": "surface", "C": "clean", "S": "points"}
SOURCES = {"M": "M", "C": "C", "S": "S", "S+C": "SC", "S+C+M": "SCM"}
STEPS, UNIT = 600, 0.05
"""Optimiser steps of a network, and the metres that become 1 for it."""
DRAWS, WEIGHT, LABELS = 8, 10.0, (1, 3, 5)
JUDGED = 200
"""Simulated scans that the CAD is weighed on."""
OPTIONS = (
    "--object-size file --units mm --pose resting --scene table --crop mask --views 1 "
    "--table-cut 0:0.01 --sampling random --num-points 4096"
)


def main() -> None:
    parser = arguments(__doc__, "shared", "out", seeds=(0, 1, 2))
    parser.add_argument("--workers", type=int, default=len(os.sched_getaffinity(0)))
    parser.add_argument("--scans-per-mesh", type=int, default=20)
    parser.add_argument("--grid", type=float, help="edge in metres; default: no grid")
    parser.add_argument(
        "--network-seeds", type=int, default=1, help="of these, the first so many; 0: no network"
    )
    options = parser.parse_args()
    benchmark = Benchmark(options)
    lines = benchmark.sources() + benchmark.networks() + benchmark.fits() + benchmark.few_labels()
    table = ["| learner | source | right % | class mean % | difference |", "|---|---|---|---|---|"]
    unknown = benchmark.unknown()
    keep(options, "parts", [*table, *lines, *benchmark.lost, "", *unknown], benchmark.answers)


class Benchmark:
    """Descriptors of sources and of real clouds, and what was answered so far."""

    def __init__(self, options: argparse.Namespace) -> None:
        shared, self.out = options.shared / "parts", options.out
        self.seeds, self.workers = options.seeds, options.workers
        self.network_seeds = self.seeds[: options.network_seeds]
        self.clouds, self.labels, self.names, called = real_parts(options.shared)
        self.library = Library.of_folder(shared / "cad", "mm")
        self.varied = described(self.clouds)
        self.target = self.varied[0]
        self.scans: dict[int, list[np.ndarray]] = {}
        self.surfaces: dict[int, list[np.ndarray]] = {}
        self.turned: dict[int, dict[str, list[np.ndarray]]] = {}
        self.features: dict[int, dict[str, np.ndarray]] = {}
        self.classes = np.empty(0, dtype=np.int64)
        for seed in self.seeds:
            place = scan(shared, self.out, seed, options)
            self.turned[seed], self.features[seed] = {}, {}
            for letter, kind in KINDS.items():
                found = read_ragged(place, kind)
                assert found.labels is not None and found.class_names == self.names
                whole = [np.unique(cloud, axis=0) for cloud in found.clouds]
                if letter == "S":
                    self.scans[seed] = whole
                if letter == "M":
                    self.surfaces[seed] = whole
                clouds = [principal(cloud) for cloud in whole]
                self.turned[seed][letter] = clouds
                self.features[seed][letter] = described(clouds)
                self.classes = np.asarray(found.labels, dtype=np.int64)
        self.right: dict[str, np.ndarray] = {}
        self.answers: list[list[object]] = [
            ["learner", "seed", *called],
            ["label", "", *self.labels.tolist()],
        ]

    def train(self, letters: str, seed: int, left_out: int | None = None) -> np.ndarray:
        """Return the probabilities of the real clouds by a forest; a class may be left out."""
        features = np.concatenate([self.features[seed][letter] for letter in letters], axis=1)
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
        seeds = self.seeds[: len(answers)]
        self.answers += [
            [name, seed, *row] for seed, row in zip(seeds, answers.tolist(), strict=True)
        ]
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
            name: np.stack([self.train(letters, seed) for seed in self.seeds])
            for name, letters in SOURCES.items()
        }
        against = {"C": "forest M", "S": "forest C", "S+C": "forest S", "S+C+M": "forest S"}
        return [
            self.row("forest", name, found.argmax(axis=2), against.get(name, ""))
            for name, found in self.found.items()
        ]

    def networks(self) -> list[str]:
        """Train a PointNet on each source; clouds keep their metric size."""
        if not self.network_seeds:
            return []
        chosen = {name: letters for name, letters in SOURCES.items() if name != "S+C"}
        jobs = [(letters, seed) for letters in chosen.values() for seed in self.network_seeds]
        with ProcessPoolExecutor(self.workers, get_context("spawn")) as pool:
            found = np.stack([*pool.map(self.train_network, *zip(*jobs, strict=True))])
        found = found.reshape(len(chosen), len(self.network_seeds), -1)
        return [
            self.row("PointNet", name, answers, f"forest {name}")
            for name, answers in zip(chosen, found, strict=True)
        ]

    def train_network(self, letters: str, seed: int) -> np.ndarray:
        """Return the answers of a PointNet; a run that is there already is not made again."""
        clouds = [cloud for letter in letters for cloud in self.turned[seed][letter]]
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
        shares = (
            load_trained(run).describe(stack(self.clouds, None, "target", LARGEST)).probabilities
        )
        return shares.argmax(axis=1)

    def fits(self) -> list[str]:
        """Compare the CAD with the clouds; weigh it on simulated scans that are held out."""
        rows = np.sort(np.random.default_rng(0).permutation(len(self.classes))[:JUDGED])
        self.seen = self.compare("real", self.clouds)
        alone = np.nan_to_num(self.seen[:, :, 4], nan=-np.inf).argmax(axis=1)
        lines = [self.row("CAD alone", "–", alone[None])]
        self.lost = ["", "| lost | right ones % | wrong ones % |", "|---|---|---|"]
        self.points = np.array([len(cleaned(cloud)) for cloud in self.clouds])
        judged = {seed: [self.scans[seed][row] for row in rows] for seed in self.seeds}
        compared = {
            seed: self.compare(
                f"simulated-{seed}", judged[seed], [self.surfaces[seed][row] for row in rows]
            )
            for seed in self.seeds
        }
        for name in ("S", "S+C+M"):
            answers, lost = [], []
            for seed, shares in zip(self.seeds, self.found[name], strict=True):
                forest = self.held_out(SOURCES[name], seed)[rows]
                clouds = [cleaned(cloud) for cloud in judged[seed]]
                posed = compared[seed][range(len(rows)), self.classes[rows], 5] > 0
                known = self.names, self.classes[rows], clouds, forest, compared[seed], posed
                real = searched(shares, self.seen)
                both = zip(shares, real[:, :, :3], self.points.tolist(), strict=True)
                fusion = weighed(*known)
                answers.append([fusion.probabilities(*one).argmax() for one in both])
                off = np.nan_to_num(real[range(len(real)), answers[-1], 3], nan=np.inf)
                found = [(self.names[k], o) for k, o in zip(answers[-1], off, strict=True)]
                fusion = fusion.of_scans(found)  # as `qs3 adapt` does
                agreed = compared[seed][range(len(rows)), self.classes[rows]][:, [3, 6]].tolist()
                right = zip(self.classes[rows], agreed, posed, strict=True)
                fusion = fusion.of_shown((self.names[k], *one) for k, one, is_in in right if is_in)
                shown = np.nan_to_num(self.seen[range(len(real)), answers[-1], 6])
                both = zip(found, shown.tolist(), strict=True)
                lost.append([fusion.lost(*one, seen) for one, seen in both])
            lines.append(self.row("forest and CAD", name, np.array(answers), f"forest {name}"))
            flags, right = np.array(lost), answers == self.labels
            shares = [f"{100 * flags[which].mean():.0f}" for which in (right, ~right)]
            self.lost.append(f"| {name} | {' | '.join(shares)} |")
        return lines

    def compare(
        self, name: str, clouds: Sequence[np.ndarray], surfaces: Sequence[np.ndarray | None] = ()
    ) -> np.ndarray:
        """Return what `agreed` does of each cloud; it is kept in a file."""
        path = self.out / f"agreed-9-{name}.npy"
        if not path.is_file():
            work = partial(agreed, library=self.library, names=self.names)
            with ProcessPoolExecutor(self.workers) as pool:
                rows = pool.map(work, clouds, surfaces or [None] * len(clouds))
                np.save(path, list(tqdm(rows, f"CAD, {name}", len(clouds), unit="cloud")))
        return np.load(path)

    def held_out(self, letters: str, seed: int) -> np.ndarray:
        """Return the probabilities of simulated scans by forests that did not learn from them."""
        numbers = self.features[seed]
        features = np.concatenate([numbers[letter] for letter in letters], axis=1)
        labels = np.tile(self.classes, len(letters))

        def fit_kept(kept: np.ndarray) -> Forest:
            some = np.tile(kept, len(letters))
            return fit_forest(features[:, some], labels[some], self.names, seed=seed)

        return held_out(fit_kept, numbers["S"][0], self.classes, seed)

    def few_labels(self) -> list[str]:
        """Add labelled clouds to S+C+M; all numbers of labels are scored on the same clouds."""
        features = np.concatenate([*self.features[self.seeds[0]].values()], axis=1)
        classes, lines = np.tile(self.classes, len(KINDS)), []
        plain = self.found["S+C+M"][0].argmax(axis=1)
        for number in LABELS:
            scores = []
            for draw in range(DRAWS):
                rng, known, scored = np.random.default_rng(draw), [], []
                for k in range(len(self.names)):
                    rows = rng.permutation(np.flatnonzero(self.labels == k))
                    most = min(LABELS[-1], len(rows) - 1)  # one is left to score
                    known.extend(rows[: min(number, most)])
                    scored.extend(rows[most:])
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
                f"| forest, labels per class: {number} | S+C+M | {right:.1f} | {mean:.1f} | "
                f"to forest S+C+M on the same clouds: {right - before:+.1f} points |"
            )
        return lines

    def unknown(self) -> list[str]:
        """Leave each part out in turn; how well do three scores tell its clouds from the others?"""
        areas = []
        for k in range(len(self.names)):
            found = self.train("SCM", self.seeds[0], left_out=k)
            entropy = -(found * np.log(found + 1e-12)).sum(axis=1)
            seen = searched(found, self.seen)[:, :, 0]
            seen[:, k] = np.nan
            misfit = np.nanmin(np.where(np.isfinite(seen), seen, 1e3), axis=1)
            both = rankdata(entropy) + rankdata(misfit)
            scores = entropy, 1 - found.max(axis=1), misfit, both
            areas.append([roc_auc_score(self.labels == k, score) for score in scores])
        columns = "entropy", "1 − largest probability", "misfit of CAD", "ranks, 1 + 3"
        lines = [f"| part left out | {' | '.join(columns)} |", "|---|---|---|---|---|"]
        for name, row in zip((*self.names, "mean"), (*areas, np.mean(areas, axis=0)), strict=True):
            lines.append(f"| {name} | " + " | ".join(f"{area:.2f}" for area in row) + " |")
        return lines


def described(clouds: Sequence[np.ndarray]) -> np.ndarray:
    """Return the descriptors of clouds and of their copies, as a forest is trained on them."""
    return describe_varied([cleaned(cloud) for cloud in clouds])


def agreed(
    cloud: np.ndarray, surface: np.ndarray | None, library: Library, names: tuple[str, ...]
) -> np.ndarray:
    """Return what `row_of` does, whether a pose lies on the true surface, and the visible share."""
    found = locate(library, cleaned(cloud).astype(float)).candidates
    posed = [is_posed(library, found, name, surface) for name in names]
    shown = dict.fromkeys(names, np.nan) | {one.class_name: one.visible for one in reversed(found)}
    return np.column_stack([row_of(found, names), posed, [*shown.values()]])


def row_of(candidates: tuple[Candidate, ...], names: tuple[str, ...]) -> np.ndarray:
    """Return misfit, residual, surprise, disagreement and rank of the best of each class.

    The disagreement is that of the pose alone, whatever other classes agree better.
    """
    alone = tuple(replace(one, beaten=1.0) for one in candidates)
    seen, ranks = Seen({}, alone), dict.fromkeys(names, np.nan)
    ranks |= {one.class_name: one.agreement for one in reversed(candidates)}
    columns = seen.agreed(names), seen.disagreement(names), [*ranks.values()]
    return np.column_stack(columns)


def scan(shared: Path, out: Path, seed: int, options: argparse.Namespace) -> Path:
    """Scan the parts as the camera of the real clouds may have; returns the data set's folder."""
    for path in sorted((shared / "cad").glob("*.stl")):
        (out / "cad" / path.stem).mkdir(parents=True, exist_ok=True)
        shutil.copy(path, out / "cad" / path.stem)
    source = out / f"source-{seed}"
    words = f"-m qs3 generate --sensor {shared / 'xtion.toml'} {OPTIONS} --seed {seed}"
    words += f" --workers {options.workers} --scans-per-mesh {options.scans_per_mesh}"
    words += f" --meshes {out / 'cad'} --out {source}"
    words += f" --grid {options.grid}" if options.grid is not None else ""
    subprocess.run([sys.executable, *words.split()], check=True)
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
