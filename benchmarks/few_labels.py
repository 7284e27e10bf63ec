"""Labels by `qs3 suggest` against random ones: a head on `rooms`, on NYU's strict-dev objects.

Run: python benchmarks/few_labels.py --shared DIR [--results results/few-labels]

DIR holds nyuv2_objects.npz. A draw splits the objects of strict-dev in two by blocks of 13 in the
order of filming: labels are picked in one half, the other half is scored, which neither way of
picking sees. The head (`qs3.training.head`) learns from the picked labels. Writes one line a draw,
number and way to `few-labels.csv`, and means with 95 % intervals, paired over draws, to
`few-labels.md`. The weight decay of the head was chosen on these objects.
"""

import argparse
import csv
import os
from pathlib import Path

os.environ["OMP_NUM_THREADS"] = "1"  # before anything counts the cores

import numpy as np
from scipy import stats

from qs3.answers.answer import load_trained
from qs3.clouds.load import load_clouds
from qs3.evaluation.metrics import class_mean_accuracy
from qs3.files import write_text
from qs3.training.head import fit_correction
from qs3.workflow.suggest import pick_spread

DRAWS, NUMBERS, BLOCK = 20, (20, 50, 100), 13
HEADER = ("labels", "way", "draw", "right %", "class mean %", "classes")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--shared", type=Path, required=True)
    parser.add_argument("--results", type=Path, default=Path("results/few-labels"))
    options = parser.parse_args()
    loaded = load_trained(Path("rooms"))
    loading = {"split": "strict-dev", "num_points": None, "class_names": loaded.class_names}
    clouds = load_clouds(options.shared / "nyuv2_objects.npz", **loading)
    described, labels = loaded.describe(clouds.points), clouds.labels
    rows = []
    for draw in range(DRAWS):
        rng = np.random.default_rng(draw)
        blocks = np.arange(len(labels)) // BLOCK
        pooled = np.isin(blocks, rng.permutation(blocks.max() + 1)[: (blocks.max() + 1) // 2])
        pool, rest = np.flatnonzero(pooled), np.flatnonzero(~pooled)
        shuffled = rng.permutation(pool)
        unsure = 1 - described.probabilities[pool].max(axis=1)
        features = described.features[pool]
        for number in NUMBERS:
            picks = {
                "none": pool[:0],
                "random": shuffled[:number],
                "suggest": pool[pick_spread(features, unsure, number)],
                "spread alone": pool[pick_spread(features, np.ones(len(pool)), number)],
                "suggest by class": pool[
                    pick_by_class(described.probabilities[pool], features, number)
                ],
                "unsure alone": pool[np.argsort(-unsure, kind="stable")[:number]],
            }
            for way, picked in picks.items():
                logits = described.logits[rest]
                if len(picked):
                    few = described.features[picked], described.logits[picked], labels[picked]
                    weight, bias = fit_correction(*few)
                    logits = logits + described.features[rest] @ weight + bias
                answers = logits.argmax(axis=1)
                right = 100 * (answers == labels[rest]).mean()
                mean = 100 * class_mean_accuracy(labels[rest], answers, logits.shape[1])
                rows.append((number, way, draw, right, mean, len(np.unique(labels[picked]))))
    options.results.mkdir(parents=True, exist_ok=True)
    with (options.results / "few-labels.csv").open("w", encoding="utf-8", newline="") as file:
        table = [(*row[:3], f"{row[3]:.2f}", f"{row[4]:.2f}", row[5]) for row in rows]
        csv.writer(file).writerows([HEADER, *table])
    text = summary(rows)
    write_text(options.results / "few-labels.md", text)
    print(text)


def pick_by_class(shares: np.ndarray, features: np.ndarray, count: int) -> np.ndarray:
    """Pick as `suggest` within each predicted class, from all classes in turn."""
    answers, unsure, picked = shares.argmax(axis=1), 1 - shares.max(axis=1), []
    for k in np.unique(answers):
        members = np.flatnonzero(answers == k)
        order = pick_spread(features[members], unsure[members], count)
        picked += [(place, k, row) for place, row in enumerate(members[order])]
    return np.array([row for _, _, row in sorted(picked)[:count]])


def summary(rows: list[tuple]) -> str:
    """Return the table of means, each against random labels of the same draws."""
    lines = ["| labels | way | right % | to random | class mean % | to random | classes |"]
    lines.append("|---|---|---|---|---|---|---|")
    for number, way in dict.fromkeys((row[0], row[1]) for row in rows):
        chosen, other = (
            np.array([row[3:] for row in rows if row[:2] == (number, name)], dtype=float)
            for name in (way, "random")
        )
        right, mean, classes = chosen.mean(axis=0)
        to = [interval(chosen[:, i] - other[:, i]) if way != "random" else "–" for i in range(2)]
        lines.append(
            f"| {number} | {way} | {right:.1f} | {to[0]} | {mean:.1f} | {to[1]} | {classes:.1f} |"
        )
    return "\n".join([*lines, ""])


def interval(differences: np.ndarray) -> str:
    """Return the mean of paired differences and Student's 95 % interval over draws."""
    middle, half = differences.mean(), stats.sem(differences) * stats.t.ppf(0.975, DRAWS - 1)
    return f"{middle:+.1f} ({middle - half:+.1f} to {middle + half:+.1f})"


if __name__ == "__main__":
    main()
