"""Train a small PointNet on whole surfaces and adapt it to one-sided clouds without labels.

Takes about ten seconds. Three classes, tens of clouds: it shows the calls, not a result.
"""

import tempfile
from pathlib import Path

import numpy as np

from qs3 import shapes
from qs3.clouds.types import PointClouds
from qs3.meshes import normalise, sample_surface
from qs3.runs import SelfTrainingSettings, TrainSettings
from qs3.training import fit, load_model, predict_probabilities

CLASSES = ("chair", "lamp", "table")


def clouds(seeds: range, one_sided: bool) -> PointClouds:
    """Surface samples; one-sided ones keep the half that faces +x."""
    points, labels, ids = [], [], []
    for label, name in enumerate(CLASSES):
        for seed in seeds:
            cloud = sample_surface(
                normalise(shapes.make(name, seed)), 1024, np.random.default_rng(seed)
            )
            if one_sided:
                cloud = cloud[np.argsort(-cloud[:, 0])[:512]]
            points.append(cloud[:512])
            labels.append(label)
            ids.append(f"{name}/{seed}")
    return PointClouds(np.stack(points), np.array(labels), CLASSES, tuple(ids))


source, target = clouds(range(30), one_sided=False), clouds(range(100, 120), one_sided=True)
settings = TrainSettings(
    model="pointnet",
    # quick: narrow layers, without the T-Nets
    model_settings={"transforms": False, "channels": (32, 32, 128), "hidden": (64, 32)},
    num_points=256,
    epochs=15,
    batch_size=16,
    learning_rate=4e-3,
    seed=0,
)
rounds = SelfTrainingSettings(rounds=3, epochs=3)
with tempfile.TemporaryDirectory() as folder:
    fit("source-only", source, None, settings, run_dir=Path(folder) / "source-only")
    fit(
        "qbst",
        source,
        target.without_labels(),  # the type that training takes has no labels
        settings,
        rounds,
        run_dir=Path(folder) / "qbst",
        warm_up=Path(folder) / "source-only",
    )
    for run in ("source-only", "qbst"):
        model = load_model(Path(folder) / run).model
        answers = predict_probabilities(model, target.points, num_points=256).argmax(axis=1)
        print(f"{run}: {(answers == target.labels).mean():.1%} of {len(target)} one-sided clouds")
