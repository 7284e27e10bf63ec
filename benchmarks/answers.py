"""Can a network's answers on real objects be mended without training it? NYU's first 70 %.

Run: python benchmarks/answers.py --out runs/real --shared DIR --source DIR
         [--results results/answers] [--cell "S again"] [--seeds 0 1 2]

Asks runs of `benchmarks/real.py`: as they answer; the mean of answers over turns about z, over
draws of their points, over runs of all seeds; and with the class prior put right, by expectation
maximisation from the answers alone (Saerens et al., 2002) or by the true shares, which a user does
not know: what looks at labels is a bound. Writes answers.csv and answers.md.
"""

import argparse
import sys
from pathlib import Path

import numpy as np
import pandas as pd
from real import parts

from qs3.adaptation.priors import estimate_prior_em
from qs3.evaluation.metrics import mean_sem
from qs3.evaluation.records import score
from qs3.evaluation.tables import to_markdown
from qs3.files import write_text
from qs3.io import load_clouds
from qs3.io.preparation import normalise
from qs3.training import load_model
from qs3.training.checkpoint import LoadedModel
from qs3.training.predict import describe, describe_turned
from qs3.training.prepared import Prepared, prepare_clouds

TIMES = 8
"""Turns, and draws."""


def answers(
    loaded: LoadedModel, clouds: Prepared, source_prior: np.ndarray, true_prior: np.ndarray
) -> dict[str, np.ndarray]:
    """Class probabilities of clouds [b k], by way of asking."""

    rng = np.random.default_rng(0)
    assert clouds.order is not None
    draws = []
    for _ in range(TIMES):
        picks = [rng.permutation(count) for count in clouds.order.counts]
        rows = np.stack([np.resize(pick, clouds.num_points) for pick in picks])
        index = np.take_along_axis(clouds.indices(slice(None)), rows, axis=1)
        chosen = np.take_along_axis(clouds.clouds.points, index[:, :, None], axis=1)
        points = normalise(chosen, clouds.preparation)
        draws.append(describe(loaded.model, points).probabilities)
    plain = describe(loaded.model, clouds).probabilities
    estimated = estimate_prior_em(plain, source_prior)
    return {
        "as they are": plain,
        f"mean of {TIMES} turns": describe_turned(loaded.model, clouds, TIMES).probabilities,
        f"mean of {TIMES} draws of points": np.mean(draws, axis=0),
        "prior by expectation maximisation": plain * estimated / source_prior,
        "true prior (bound)": plain * true_prior / source_prior,
    }


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--shared", type=Path, required=True)
    parser.add_argument("--source", type=Path, required=True)
    parser.add_argument("--results", type=Path, default=Path("results/answers"))
    parser.add_argument("--cell", default="S again")
    parser.add_argument("--seeds", nargs="+", type=int, default=[0, 1, 2])
    options = parser.parse_args()
    data = parts(options.shared)["dev"]
    labels = data.labels
    learnt = load_clouds(options.source, cloud="points", num_points=None)
    assert learnt.class_names == data.class_names
    shares = [np.bincount(y, minlength=len(data.class_names)) for y in (learnt.labels, labels)]
    priors = [count / count.sum() for count in shares]
    said: dict[str, list[np.ndarray]] = {}
    for seed in options.seeds:
        loaded = load_model(options.out / f"{options.cell}-{seed}")
        assert loaded.num_points is not None
        prepared = prepare_clouds(data, loaded.num_points, loaded.preparation)
        for way, given in answers(loaded, prepared, *priors).items():
            said.setdefault(way, []).append(given)
    ways = {way: list(given) for way, given in said.items()}
    ways["mean of the runs"] = [np.mean(said["as they are"], axis=0)]
    lines, told = [], []
    for way, given in ways.items():
        names = ("accuracy", "class_mean_accuracy")
        made = [score(labels, rows.argmax(axis=1), data.class_names) for rows in given]
        scores = [tuple(getattr(one, name) for name in names) for one in made]
        for run, pair in enumerate(scores):
            lines.append({"way": way, "run": run} | dict(zip(names, pair, strict=True)))
        means = [mean_sem(list(column)) for column in zip(*scores, strict=True)]
        told.append({"answers": way} | {n: m.format() for n, m in zip(names, means, strict=True)})
    options.results.mkdir(parents=True, exist_ok=True)
    table = pd.DataFrame(lines).to_csv(index=False, float_format="%.4f", lineterminator="\n")
    write_text(options.results / "answers.csv", table)
    head = f"Answers of *{options.cell}* on {len(labels)} objects of NYU, first 70 %"
    text = to_markdown(pd.DataFrame(told))
    write_text(
        options.results / "answers.md", f"{head}; `benchmarks/answers.py` made it.\n\n{text}\n"
    )
    return 0


if __name__ == "__main__":
    sys.exit(main())
