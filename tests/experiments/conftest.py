"""A bench so small that its grid takes seconds: blobs in place of scans, a narrow PointNet."""

import dataclasses
import json
import os

import numpy as np
import pytest
from qs3.experiments.adaptation_bench import Bench, make_bench
from qs3.experiments.bench_data import make_plans

from qs3.cli import reproduce as command
from qs3.experiments.scales import SCALES, Scale
from qs3.experiments.setup import Setup
from qs3.store.generate import generate, scan_seed
from qs3.store.shards import CloudRow
from qs3.training import TrainSettings

TINY = Scale(
    name="smoke",
    source_per_class=3,
    target_per_class=2,
    test_per_class=2,
    common_factor=2,
    source_views=1,
    data_points=64,
    train=TrainSettings(
        model="pointnet",
        model_settings={"channels": (8, 8, 16), "hidden": (8,), "transforms": False},
        num_points=32,
        epochs=4,
        learning_rate=2e-2,
        batch_size=16,
        validate_every=1,
        accelerator="cpu",
    ),
    rounds={"threshold": 0.0, "rounds": 2, "epochs": 1},
    tasks=("M-D", "S-D"),
    networks={
        "pointnet2": {
            "centres": (8, 4),
            "scales": (((0.5, 4, (8, 8)),), ((1.0, 4, (8, 8)),)),
            "embedding": (16,),
        },
        "dgcnn": {"neighbours": 4, "channels": (8, 8), "embedding": 16, "hidden": (8,)},
    },
    fused_views=(1, 2),
    thetas=(0.0, 0.2),
    steps=(0.0, 0.1),
    sensors=("qs3", "d435"),
    pointda10=("ordinary", "qbst-paper"),
)


def blob_row(item, scan, settings, neighbour=None):
    """A cloud whose proportions tell its class; the target's are noisier."""
    seed = scan_seed(settings.seed, item.id, scan)
    rng = np.random.default_rng(seed)
    label = settings.classes.index(item.class_name)
    shape = np.random.default_rng(label).uniform(0.1, 1, 3)
    n = settings.num_points
    clouds = {
        name: (rng.normal(size=(n, 3)) * shape + noise * rng.normal(size=(n, 3))).astype("float32")
        for name, noise in (("points", 0.1), ("clean", 0.0), ("surface", 0.0))
    }
    return CloudRow(
        id=f"{item.id}#{scan}",
        object=item.id,
        scan=scan,
        label=label,
        class_name=item.class_name,
        split=item.split,
        seed=seed,
        view=np.zeros(n, np.uint8),
        clean_view=np.zeros(n, np.uint8),
        yaw=0.0,
        valid_fraction=1.0,
        **clouds,
    )


@pytest.fixture
def tiny():
    return TINY


@pytest.fixture
def make(tmp_path):
    """Make a bench on ready data and return its table; keeps what it told."""

    class Make:
        train = staticmethod(command._train)
        evaluate = staticmethod(command._evaluate)

        def __init__(self):
            self.told = []

        def data(self, out, sets=("source", "target")):
            if not out.exists():
                for name, plan in make_plans(TINY, None, sets=sets).items():
                    folder = out / "data" / name
                    generate(
                        plan.items, folder, plan.settings, scan_one=blob_row, workers=0,
                        progress=False,
                    )  # fmt: skip
                marker = {"scale": dataclasses.asdict(TINY), "threads": 1, "meshes": "shapes"}
                marker["data"] = {}
                (out / "bench.json").write_text(json.dumps(marker), encoding="utf-8")

        def bench(self, out, **changes):
            told = {"rows": ("source-only", "qbst"), "tasks": ("S-D",), "seeds": (0,)}
            told |= changes
            rows, tasks = told.pop("rows"), told.pop("tasks")
            setup = Setup(out, TINY, **({"threads": 1, "workers": 1} | told))
            return Bench("adaptation-bench", setup, rows, tasks)

        def __call__(self, out, **changes):
            self.data(out)
            self.told.clear()
            bench = self.bench(out, **{k: v for k, v in changes.items() if k != "name"})
            if "name" in changes:
                bench = dataclasses.replace(bench, name=changes["name"])
            return make_bench(bench, self.train, self.evaluate, self.told.append)

    return Make()


@pytest.fixture
def small_scales(monkeypatch):
    monkeypatch.setitem(SCALES, "smoke", TINY)
    monkeypatch.delitem(os.environ, "QS3_SHARED_DATA", raising=False)
