"""Are the built-in shapes believable? Train on them alone, test on artists' meshes.

    python benchmarks/shapes_to_cad.py $QS3_SHARED_DATA/cad [--per-class 120] [--epochs 10]

A PointNet sees surface samples of built-in shapes and is scored on surface samples of the meshes.
"""

import argparse
import tempfile
from pathlib import Path

import numpy as np

from qs3 import shapes
from qs3.cli.evaluate import scores_text
from qs3.evaluation import score
from qs3.io.clouds import PointClouds
from qs3.meshes import collect, normalise, sample_surface
from qs3.training import TrainSettings, fit, predict_probabilities


def surfaces(items: list, seed: int, points: int = 512) -> PointClouds:
    clouds = [
        sample_surface(normalise(item.load()), points, np.random.default_rng([seed, index]))
        for index, item in enumerate(items)
    ]
    labels = np.array([shapes.CLASSES.index(item.class_name) for item in items])
    return PointClouds(
        np.stack(clouds), labels, tuple(shapes.CLASSES), tuple(item.id for item in items)
    )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("cad", type=Path)
    parser.add_argument("--per-class", type=int, default=120)
    parser.add_argument("--epochs", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    source = surfaces(collect("shapes", per_class=options.per_class, seed=options.seed), 0)
    test = surfaces(collect(options.cad), 1)
    settings = TrainSettings(
        model="pointnet",
        model_settings={"transforms": False},
        num_points=512,
        epochs=options.epochs,
        seed=options.seed,
    )
    with tempfile.TemporaryDirectory() as folder:
        model = fit("source-only", source, None, settings, run_dir=Path(folder) / "run").model
    answers = predict_probabilities(model, test.points).argmax(axis=1)
    print(scores_text(score(test.labels, answers, test.class_names)))


if __name__ == "__main__":
    main()
