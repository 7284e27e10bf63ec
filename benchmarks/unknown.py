"""How well a network tells that an object is of none of its classes: two of them are left out.

Run: python benchmarks/unknown.py --source DIR --shared DIR --out runs/unknown
         [--records results/unknown] [--left-out lamp,plant monitor,sofa] [--steps 1200]

DIR of --source and --shared are those of `real.py`; the network is its `rooms`, with fewer steps.
Real objects are those of its development part, the first 70 % of the frames, alone. Writes one JSON
file a pair: for each score the AUROC of known over unknown objects, and the share of both that is
refused where 5 % of the held-out source is; and how well calibrated the confidence is.
"""

import argparse
import os
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

os.environ["OMP_NUM_THREADS"] = "1"  # before anything counts the cores

import numpy as np
from real import ROOMS, parts, settings_of
from sklearn.metrics import roc_auc_score
from sklearn.neighbors import NearestNeighbors
from sklearn.preprocessing import normalize

from qs3.adaptation.confidence import energy, fit_temperature, rescale
from qs3.files import write_json
from qs3.io import load_clouds
from qs3.io.clouds import PointClouds
from qs3.training import fit
from qs3.training.loaded import Description
from qs3.training.predict import describe
from qs3.training.prepared import prepare_clouds

SHARE = 0.05
FEW, MANY, NEIGHBOURS = 300, 3000, 50
SCORES = {
    "energy": lambda said: energy(said.logits),
    "max logit": lambda said: said.logits.max(axis=1),
    "max softmax": lambda said: said.probabilities.max(axis=1),
}
"""Higher of known objects: Liu et al. 2020, Hendrycks et al. 2022, Hendrycks & Gimpel 2017."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--source", type=Path, required=True)
    parser.add_argument("--shared", type=Path, required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--records", type=Path, default=Path("results/unknown"))
    parser.add_argument("--left-out", nargs="+", default=["lamp,plant", "monitor,sofa"])
    parser.add_argument("--steps", type=int, default=1200)
    options = parser.parse_args()
    for names in options.left_out:
        record = measure(options, names.split(","))
        write_json(options.records / f"{names.replace(',', '-')}.json", record)
        print(names, record["known"], record["unknown"], record["scores"], flush=True)


def measure(options: argparse.Namespace, left_out: list[str]) -> dict[str, Any]:
    """Train without two classes, and tell known from unknown objects."""
    cell = replace(ROOMS, steps=options.steps)
    whole = load_clouds(options.source, cloud=cell.cloud, num_points=None)
    source = without(whole, left_out)
    settings = settings_of(cell, len(source), 0)
    run = options.out / "-".join(left_out)
    result = fit("source-only", source, None, settings, run_dir=run)
    real, rng = parts(options.shared)["dev"], np.random.default_rng(0)
    # Clouds of the classes that were left out, as the source has them: no gap between the domains.
    others = whole.select(np.isin(np.array(whole.class_names)[whole.labels], left_out))
    others = others.select(np.sort(rng.permutation(len(others))[:FEW]))
    clouds, others = (
        prepare_clouds(one, settings.num_points, settings.preparation) for one in (real, others)
    )
    rows = np.sort(rng.permutation(len(result.source))[:MANY])
    said, held, simulated, seen = (
        describe(result.model, one)
        for one in (clouds, result.holdout, others, result.source.select(rows))
    )
    unknown = np.isin(np.array(real.class_names)[real.labels], left_out)
    truth = np.array([(*source.class_names, *left_out).index(name) for name in real.class_names])
    truth = truth[real.labels]
    scores = {}
    for name, score in (SCORES | {"neighbour": nearness(seen.features)}).items():
        values, known, new = score(said), score(held), score(simulated)
        refused = values < np.quantile(known, SHARE)
        scores[name] = {
            "auroc_simulated": roc_auc_score([1] * len(known) + [0] * len(new), [*known, *new]),
            "auroc": roc_auc_score(~unknown, values),
            "refused_known": refused[~unknown].mean(),
            "refused_unknown": refused[unknown].mean(),
            "accuracy_of_known": right(said.probabilities, truth, ~unknown),
            "accuracy_of_known_not_refused": right(said.probabilities, truth, ~unknown & ~refused),
        }
    temperature = fit_temperature(held.probabilities, result.holdout.labels)
    rows = {
        "held-out source": (held.probabilities, result.holdout.labels),
        "known real": (said.probabilities[~unknown], truth[~unknown]),
    }
    errors = {
        name: {
            "as it is": calibration_error(shares, labels),
            "calibrated": calibration_error(rescale(shares, temperature), labels),
        }
        for name, (shares, labels) in rows.items()
    }
    record = {
        "left_out": left_out,
        "steps": options.steps,
        "share": SHARE,
        "known": (~unknown).sum(),
        "unknown": unknown.sum(),
        "held_out": len(result.holdout),
        "scores": scores,
        "temperature": temperature,
        "calibration_error": errors,
    }
    return plain(record)


def nearness(seen: np.ndarray) -> Callable[[Description], np.ndarray]:
    """Minus the distance to the k-th nearest training cloud, of features of length 1 (Sun 2022)."""
    index = NearestNeighbors(n_neighbors=NEIGHBOURS).fit(normalize(seen))
    return lambda said: -index.kneighbors(normalize(said.features))[0][:, -1]


def without(clouds: PointClouds, left_out: list[str]) -> PointClouds:
    """Return the clouds of the other classes, whose labels are numbered anew."""
    names = tuple(name for name in clouds.class_names if name not in left_out)
    kept = clouds.select(np.isin(np.array(clouds.class_names)[clouds.labels], names))
    numbers = np.array([names.index(n) if n in names else -1 for n in clouds.class_names])
    return replace(kept, class_names=names, labels=numbers[kept.labels], checksum="")


def right(shares: np.ndarray, labels: np.ndarray, rows: np.ndarray) -> float:
    return (shares.argmax(axis=1) == labels)[rows].mean()


def calibration_error(shares: np.ndarray, labels: np.ndarray, bins: int = 10) -> float:
    """Expected calibration error (Guo et al., 2017, Eq. 3), bins of equal width."""
    confidence, correct = shares.max(axis=1), shares.argmax(axis=1) == labels
    place = np.minimum((confidence * bins).astype(int), bins - 1)
    gaps = [correct[place == i].sum() - confidence[place == i].sum() for i in range(bins)]
    return np.abs(gaps).sum() / len(labels)


def plain(value: Any) -> Any:
    """Return figures as JSON has them, four digits after the point."""
    if isinstance(value, dict):
        return {name: plain(one) for name, one in value.items()}
    if isinstance(value, np.integer):
        return int(value)
    return round(float(value), 4) if isinstance(value, float | np.floating) else value


if __name__ == "__main__":
    main()
