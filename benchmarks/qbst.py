"""Self-training where there is a gap: ModelNet10's surfaces to real objects of NYU Depth v2.

Run: python benchmarks/qbst.py --shared DIR --out runs/qbst [--records results/qbst]
         [--arms pointnet dgcnn-sight ...] [--rows none gentle ...] [--seeds 0 1 2] [--workers 2]
     python benchmarks/qbst.py --table [--records results/qbst]

The second command writes table.md of the records; ``--shared`` writes objects.csv for it, too.

DIR holds modelnet10_1024.npz and nyuv2_objects.npz. Seven classes are shared: a desk is a table, a
dresser and a night stand are cabinets. All rounds of an arm start from its row *none* of the same
seed. Frames of NYU are in the order of filming: objects of the first 70 % are adapted to, without
labels, and objects of the others are scored (*held*), those adapted to beside them. Every network
is the last one: no label of the target chooses anything. Runs are made side by side, each in a
process of one thread; one that has its records is not made again.
"""

import argparse
import concurrent.futures
import csv
import multiprocessing
import os
import sys
import time
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cache
from itertools import repeat
from pathlib import Path
from typing import Any

os.environ |= {"OMP_NUM_THREADS": "1", "TQDM_DISABLE": "1"}  # before anything counts the cores

import numpy as np
from real import bootstrap_difference, recorded

from qs3.clouds.preparation import PAPER, ROBUST, Preparation
from qs3.clouds.types import Origin, PointClouds
from qs3.evaluation import git_commit, hardware, mean_sem, score, versions
from qs3.evaluation.metrics import SeedComparison
from qs3.evaluation.records import RECORDS, RunRecord, append_record
from qs3.files import sha256, write_text
from qs3.runs import save_model
from qs3.runs.device import threads
from qs3.runs.rounds import RoundRecord, least_clouds, select_round
from qs3.runs.run import data_record
from qs3.runs.settings import (
    PRESETS,
    Augmentation,
    PresetName,
    SelfTrainingSettings,
    TrainSettings,
)
from qs3.structure import unstructure
from qs3.training import load_model, loop, self_train
from qs3.training.predict import describe
from qs3.training.prepared import Prepared, prepare_clouds
from qs3.training.trainer import fresh_model, held_out, make_method

CLASSES = ("bathtub", "bed", "cabinet", "chair", "monitor", "sofa", "table")
CALLED = {"desk": "table", "dresser": "cabinet", "night_stand": "cabinet"}
BATCH, HELD, THETA = 32, 0.1, 0.8
EPOCHS = 18
"""Of the training before the rounds: 2,268 steps."""
MORE = 24
"""Further epochs of the control: 3,024 steps."""
SIGHT = Augmentation(sight=1.0)
"""Each cloud keeps what one camera would see of it."""
STRONG = Augmentation(
    sight=0.5, plane=0.75, plane_share=0.6, patches=0.5, stretch=1.0, tilt=1.0, noise=0.5
)
ARMS: Mapping[str, Mapping[str, Any]] = {
    "pointnet": {"model": "pointnet"},
    "pointnet-sight": {"model": "pointnet", "augmentation": SIGHT},
    "pointnet-paper": {"model": "pointnet", "preparation": PAPER},
    "dgcnn": {"model": "dgcnn"},
    "dgcnn-sight": {"model": "dgcnn", "augmentation": SIGHT},
}


@dataclass(frozen=True)
class Row:
    """A method; without a preset there are no rounds."""

    preset: PresetName | None = None
    rounds: Mapping[str, Any] = field(default_factory=dict)
    train: Mapping[str, Any] = field(default_factory=dict)
    supervised: bool = False


# Five epochs a round take at most as many steps as the control has more.
FEWER = {"epochs": 5}
ROWS: Mapping[str, Row] = {
    "none": Row(),
    "none, longer": Row(train={"epochs": EPOCHS + MORE}),
    "gentle": Row("gentle"),
    "gentle, longer": Row("gentle", {"rounds": 10, "epochs": 5}),
    "default": Row("default", FEWER),
    "strong": Row("default", FEWER, {"augmentation": STRONG}),
    "spst": Row("spst", FEWER),
    "paper": Row("paper"),
    "released": Row("released"),
    "labels": Row(supervised=True),
}
PARTS = ("held", "adapted to")
_LONG = ("losses", "accuracies", "learning_rates")


@cache
def source_clouds(shared: Path) -> PointClouds:
    """Return ModelNet10's clouds of the shared classes, both splits."""
    path = shared / "modelnet10_1024.npz"
    with np.load(path) as arrays:
        names: list[str] = arrays["class_names"].tolist()
    return _clouds(path, [CALLED.get(name, name) for name in names], {})


@cache
def target_clouds(shared: Path) -> dict[str, PointClouds]:
    """Return NYU's objects of the shared classes: to adapt to, and of other frames."""
    path = shared / "nyuv2_objects.npz"
    with np.load(path) as arrays:
        names, frame = arrays["class_names"].tolist(), arrays["frame"]
    frames = np.unique(frame)
    early = frame < frames[int(0.7 * len(frames))]
    return {name: _clouds(path, names, {name: rows})
            for name, rows in zip(PARTS, (~early, early), strict=True)}  # fmt: skip


def _clouds(path: Path, names: Sequence[str], part: Mapping[str, np.ndarray]) -> PointClouds:
    with np.load(path) as arrays:
        points, label = arrays["points"], arrays["label"]
        ids = arrays["name"].tolist()
    known = np.array([CLASSES.index(name) if name in CLASSES else -1 for name in names])[label]
    (split, chosen), *_ = part.items() or [(None, np.ones(len(label), bool))]
    rows = np.flatnonzero((known >= 0) & chosen)
    clouds, ids = points[rows].astype(np.float32), tuple(ids[row] for row in rows)
    origin = Origin(path.name, split)
    return PointClouds(clouds, known[rows], CLASSES, ids, sha256(path), origin)


def choose_points(
    whole: PointClouds, points: int, preparation: Preparation
) -> tuple[np.ndarray, ...]:
    prepared = prepare_clouds(whole, points, preparation)
    return prepared.index, prepared.counts


def prepare(options: argparse.Namespace, pool: concurrent.futures.Executor) -> None:
    """Choose the points of all clouds once, side by side, and keep the choice in --out."""
    sets = {"source": source_clouds(options.shared), **target_clouds(options.shared)}
    for name, clouds in sets.items():
        for preparation in {
            each.get("preparation", ROBUST) for each in map(ARMS.get, options.arms) if each
        }:
            path = options.out / prepared_name(name, options.points, preparation)
            if path.is_file():
                continue
            parts = [clouds.select(rows) for rows in np.array_split(np.arange(len(clouds)), 64)]
            done = pool.map(choose_points, parts, repeat(options.points), repeat(preparation))
            index, counts = map(np.concatenate, zip(*done, strict=True))
            path.parent.mkdir(parents=True, exist_ok=True)
            np.savez(path, index=index, counts=counts)


def prepared_name(name: str, points: int, preparation: Preparation) -> str:
    return f"{name}-{points}-{'paper' if preparation == PAPER else 'robust'}.npz"


@cache
def prepared(shared: Path, out: Path, points: int, preparation: Preparation) -> dict[str, Prepared]:
    """Return the source and the parts of the target as the networks of an arm get them."""
    sets = {"source": source_clouds(shared), **target_clouds(shared)}
    return {name: Prepared(clouds, np.arange(len(clouds)), points, preparation,
                           **np.load(out / prepared_name(name, points, preparation)))
            for name, clouds in sets.items()}  # fmt: skip


@dataclass
class Noting:
    """The rule of a preset, which notes the rows that each round keeps."""

    rounds: SelfTrainingSettings
    pool: np.ndarray
    kept: list[tuple[np.ndarray, np.ndarray]] = field(default_factory=list)

    def __call__(self, probabilities: np.ndarray, theta: float) -> np.ndarray:
        at = replace(self.rounds, threshold_share=None, threshold=theta, step=0.0)
        mask = select_round(at, 1, probabilities)[1]
        self.kept.append((self.pool[mask], probabilities[mask].argmax(axis=1)))
        if self.rounds.pool == "shrinking" and mask.sum() >= least_clouds(len(CLASSES)):
            self.pool = self.pool[mask]
        return mask


def make(
    out: Path, records: Path, shared: Path, points: int, arm: str, name: str, seed: int
) -> str:
    """Train one row of one arm with one seed, and score it."""
    row, begun, spent = ROWS[name], time.perf_counter(), time.process_time()
    train = TrainSettings(num_points=points, preparation=ROBUST, epochs=EPOCHS, batch_size=BATCH,
                          holdout=HELD, validate_every=0, seed=seed, threads=1)  # fmt: skip
    train = replace(train, **{**ARMS[arm], **row.train})
    sets = prepared(shared, out, points, train.preparation)
    source = sets[PARTS[1] if row.supervised else "source"]
    held = held_out(source.clouds, train)
    learnt, kept, done = source.select(~held), None, []
    if row.supervised:  # as many steps as the control
        longest = (EPOCHS + MORE) * (1 - HELD) * len(sets["source"])
        train = replace(train, epochs=round(longest / len(learnt)))
    rounds = None if row.preset is None else replace(PRESETS[row.preset], **row.rounds)
    warm_up = out / arm / f"none-{seed}"
    with threads(1):
        if rounds is None:
            method = make_method(
                "source-only", fresh_model("source-only", train, len(CLASSES)), train
            )
            epochs, _ = loop.train(method, learnt, None, train, stream=(0,))
            model, steps = method.model, sum(epoch.steps for epoch in epochs)
            save_model(out / arm / f"{name}-{seed}", model, CLASSES, train)
        else:
            whole = sets[PARTS[1]]
            target = replace(whole, clouds=whole.clouds.without_labels())
            index = np.arange(len(target))
            kept = Noting(rounds, index[index % 10 < 8] if rounds.pool == "split" else index)
            first = load_model(warm_up).model
            model, done = self_train(first, learnt, target, train, rounds, select=kept)
            steps = sum(each.steps for each in done)
        model = model.eval()
        answers = {each: describe(model, sets[each]).probabilities for each in PARTS}
        right = describe(model, source.select(held)).probabilities.argmax(1) == source.labels[held]
    total = {"total": time.perf_counter() - begun}
    scores = []
    for part, chances in answers.items():
        test, guesses = sets[part], chances.argmax(axis=1)
        sure = chances.max(axis=1) > THETA
        # How much the class shares matter: what if those of the target were known?
        shares = [np.bincount(c.labels, minlength=len(CLASSES)) for c in (test, learnt)]
        known = (chances * (shares[0] / shares[1])).argmax(axis=1) == test.labels
        fields = {"arm": arm, "row": name, "points": points, "part": part,
                  "sure": int(sure.sum()), "sure right": int((guesses == test.labels)[sure].sum()),
                  "right by shares": int(known.sum()),
                  "answers": "".join(map(str, guesses))}  # fmt: skip
        record = RunRecord(
            method="source-only" if rounds is None else f"source-only+{rounds.rule}",
            model=train.model,
            settings={"train": unstructure(train), "preset": row.preset,
                      "self_training": None if rounds is None else unstructure(rounds)},
            source=data_record(source.clouds),
            target=None if rounds is None else data_record(sets[PARTS[1]].clouds),
            test=data_record(test.clouds),
            seed=seed,
            selection="last",
            scores=score(test.labels, guesses, CLASSES),
            seconds=total,
            cpu_seconds={"total": time.process_time() - spent},
            steps={"total": steps},
            versions=versions(),
            hardware=hardware(),
            commit=git_commit(),
            rounds=count_right(done, kept, test.labels) if part == PARTS[1] else (),
            marks=marks_of(row, part),
            experiment=fields,
            source_accuracy=float(right.mean()),
        )  # fmt: skip
        append_record(records / RECORDS, record)
        scores.append(record.scores)
    both = ", ".join(f"{100 * s.accuracy:.1f} / {100 * s.class_mean_accuracy:.1f}" for s in scores)
    return f"{arm} {name}-{seed}: {total['total']:.0f} s, {steps} steps; {both}; {right.mean():.3f}"


def marks_of(row: Row, part: str) -> tuple[str, ...]:
    seen = part == PARTS[1]
    if row.supervised:
        return ("supervised", "training clouds") if seen else ("supervised",)
    return ("transductive",) if seen and row.preset else ()


def count_right(
    done: Sequence[RoundRecord], kept: Noting | None, labels: np.ndarray
) -> tuple[Mapping[str, Any], ...]:
    """Add to the record of each round how many of its pseudo labels were right, by class."""
    if kept is None:
        return ()
    counted = []
    for record, (rows, pseudo) in zip(done, kept.kept, strict=True):
        right = np.bincount(pseudo[labels[rows] == pseudo], minlength=len(CLASSES)).tolist()
        brief = {name: value for name, value in asdict(record).items() if name not in _LONG}
        counted.append({**brief, "right": right})
    return tuple(counted)


def work(options: argparse.Namespace, left: Sequence[tuple[str, str, int]]) -> int:
    """Make what is left; rounds wait for the training that they start from."""
    there, failed = recorded(options.records, "arm", "row"), 0
    place = options.out, options.records, options.shared, options.points
    context = multiprocessing.get_context("spawn")
    with concurrent.futures.ProcessPoolExecutor(options.workers, context) as pool:
        prepare(options, pool)
        waiting = [job for job in left if ROWS[job[1]].preset]
        running = {pool.submit(make, *place, *job): job for job in left if job not in waiting}

        def start(arm: str, seed: int) -> None:
            for job in [job for job in waiting if job[0] == arm and job[2] == seed]:
                waiting.remove(job)
                running[pool.submit(make, *place, *job)] = job

        for arm, seed in {(arm, seed) for arm, _, seed in waiting}:
            if (arm, "none", seed, PARTS[-1]) in there:
                start(arm, seed)
        while running:
            done, _ = concurrent.futures.wait(running, return_when="FIRST_COMPLETED")
            for future in done:
                arm, name, seed = running.pop(future)
                if error := future.exception():
                    failed += 1
                    print(f"{arm} {name}-{seed}: {error}", file=sys.stderr, flush=True)
                    continue
                print(future.result(), flush=True)
                if name == "none":
                    start(arm, seed)
    return failed + len(waiting)


def write_objects(shared: Path, folder: Path) -> None:
    """Write frame and label of each object of the target, in the order of the answers."""
    path = shared / "nyuv2_objects.npz"
    with np.load(path) as arrays:
        frames = dict(zip(arrays["name"].tolist(), arrays["frame"].tolist(), strict=True))
    lines = ["part,frame,label"]
    for part, clouds in target_clouds(shared).items():
        labels = clouds.labels.tolist()
        lines += [f"{part},{frames[n]},{k}" for n, k in zip(clouds.ids, labels, strict=True)]
    write_text(folder / "objects.csv", "\n".join([*lines, ""]))


def read_objects(folder: Path) -> dict[str, tuple[np.ndarray, np.ndarray]]:
    """Return frames and labels of the objects of each part."""
    with (folder / "objects.csv").open(encoding="utf-8", newline="") as file:
        rows = list(csv.DictReader(file))
    return {
        part: tuple(np.array([int(row[name]) for row in rows if row["part"] == part])
                    for name in ("frame", "label"))
        for part in PARTS
    }  # type: ignore[return-value]  # fmt: skip


def table(folder: Path) -> str:
    """Return the table of the records: scores, differences with intervals, pseudo labels."""
    found, objects = recorded(folder, "arm", "row"), read_objects(folder)
    frames, labels = objects[PARTS[0]]

    def right(arm: str, row: str, seeds: Sequence[int]) -> np.ndarray:
        answers = [str(found[arm, row, s, PARTS[0]].experiment["answers"]) for s in seeds]  # pyright: ignore[reportOptionalSubscript]
        return np.array([[int(letter) for letter in each] for each in answers]) == labels

    columns = ("arm", "row", "seeds", "steps", "held %", "class mean %", "to none", "to longer",
               "adapted to %", "source %", "pseudo labels right %")  # fmt: skip
    lines = ["| " + " | ".join(columns) + " |", "|---" * len(columns) + "|"]
    for arm in ARMS:
        for row in ROWS:
            seeds = sorted(s for a, r, s, p in found if (a, r, p) == (arm, row, PARTS[0]))
            if not seeds:
                continue
            both = [[found[arm, row, seed, part] for seed in seeds] for part in PARTS]
            cells = [
                arm,
                row,
                str(len(seeds)),
                f"{np.mean([one.steps['total'] for one in both[0]]):.0f}",
            ]
            cells += [spread([one.scores.accuracy for one in both[0]]),
                      spread([one.scores.class_mean_accuracy for one in both[0]])]  # fmt: skip
            for other in ("none", "none, longer"):
                shared = [s for s in seeds if (arm, other, s, PARTS[0]) in found]
                cells.append("–")
                if shared and row != other and row != "none":
                    ours, theirs = right(arm, row, shared), right(arm, other, shared)
                    cells[-1] = points(bootstrap_difference(ours, theirs, frames))
            cells += [spread([one.scores.accuracy for one in both[1]]),
                      f"{100 * np.mean([one.source_accuracy or 0.0 for one in both[0]]):.1f}",
                      pseudo(both[1])]  # fmt: skip
            lines.append("| " + " | ".join(cells) + " |")
    lines += ["", "| row | arm | held %, to the arm without sight |", "|---|---|---|"]
    for row in ROWS:
        for arm in ARMS:
            plain = arm.removesuffix("-sight")
            seeds = sorted(s for a, r, s, p in found if (a, r, p) == (arm, row, PARTS[0]))
            seeds = [s for s in seeds if (plain, row, s, PARTS[0]) in found]
            if plain != arm and seeds:
                ours, theirs = right(arm, row, seeds), right(plain, row, seeds)
                gain = points(bootstrap_difference(ours, theirs, frames))
                lines.append(f"| {row} | {arm} | {gain} |")
    return "\n".join([*lines, ""])


def spread(values: Sequence[float]) -> str:
    value = mean_sem([100 * each for each in values])
    return f"{value.mean:.1f}" + (f" ± {value.sem:.1f}" if len(values) > 1 else "")


def points(difference: SeedComparison) -> str:
    assert difference.interval is not None
    low, high = difference.interval
    return f"{100 * difference.mean:+.1f} ({100 * low:+.1f} to {100 * high:+.1f})"


def pseudo(records: Sequence[RunRecord]) -> str:
    """Return how many kept labels of the first and of the last round are right."""
    if not records[0].rounds:
        return "–"
    shares = []
    for place in (0, -1):
        kept = sum(sum(one.rounds[place]["kept"]) for one in records)
        right = sum(sum(one.rounds[place]["right"]) for one in records)
        shares.append(f"{100 * right / max(kept, 1):.0f} of {kept / len(records):.0f}")
    return " → ".join(shares)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--shared", type=Path)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--records", type=Path, default=Path("results/qbst"))
    parser.add_argument("--arms", nargs="+", default=list(ARMS), choices=list(ARMS))
    parser.add_argument("--rows", nargs="+", default=list(ROWS), choices=list(ROWS))
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    parser.add_argument("--points", type=int, default=512)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--table", action="store_true", help="write the table and stop")
    options = parser.parse_args()
    if options.table:
        if options.shared:
            write_objects(options.shared, options.records)
        write_text(options.records / "table.md", table(options.records))
    else:
        there = recorded(options.records, "arm", "row")
        left = [
            (arm, row, seed)
            for seed in options.seeds
            for row in options.rows
            for arm in options.arms
            if (arm, row, seed, PARTS[-1]) not in there
        ]
        print(f"{len(left)} runs", flush=True)
        if failed := work(options, left):
            return failed
    return 0


if __name__ == "__main__":
    sys.exit(main())
