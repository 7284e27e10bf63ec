"""A small but complete report, hostile text included."""

import warnings
from pathlib import Path

import numpy as np
import pytest

from qs3.evaluation.metrics import mean_sem
from qs3.evaluation.records import DataRecord, score
from qs3.report.contents import Cloud, FeatureMap, Report, Scored
from qs3.report.lines import ScoreLine
from qs3.report.montage import MontageView
from qs3.report.page import write_report
from qs3.report.plots import Curve, SelectionRound

from ..stores import write_store

HOSTILE = '</script><script>alert(\'x\')</script><img src="http://example.org/a.png" onerror="b()">'


def scored(name: str, matrix: np.ndarray, class_names, paired: bool = False) -> Scored:
    """A network with this confusion matrix; a column more than classes is none of them."""
    true, answers = (np.repeat(index.ravel(), matrix.ravel()) for index in np.indices(matrix.shape))
    answers = np.where(answers < len(class_names), answers, -1)
    return Scored(name, score(true, answers, class_names), true == answers if paired else None)


@pytest.fixture(scope="session")
def report() -> Report:
    rng = np.random.default_rng(20220712)
    true = np.full((24, 32), np.nan)
    true[4:20, 6:26] = np.linspace(1.0, 2.0, 20)
    depth = true + 0.01
    image = rng.integers(0, 256, true.shape, dtype=np.uint8)
    cloud = rng.normal(size=(60, 3)).astype(np.float32)
    names = ("bed", f"chair {HOSTILE}", "table")
    clouds = [
        Cloud(rng.normal(size=(50, 3)).astype(np.float32), name, f"Taken for {HOSTILE}")
        for name in names
    ]
    matrix = np.array([[6, 4, 0], [5, 5, 0], [0, 5, 5]])
    epochs = np.arange(1, 5)
    return Report(
        title=f"Title {HOSTILE}",
        summary=f"Summary {HOSTILE}",
        class_names=names,
        before=scored(f"before {HOSTILE}", matrix, names),
        after=scored(f"after {HOSTILE}", np.array([[10, 0, 0], [0, 10, 0], [0, 1, 9]]), names),
        command=f"qs3 demo {HOSTILE}",
        settings={"seed": 0, "sensor": {"views": 5, "name": HOSTILE}},
        versions={"qs3": f"0.1.0 {HOSTILE}"},
        montage=MontageView(image, image, 30 / depth, depth, true, cloud, cloud, np.eye(16)),
        montage_title=f"mesh {HOSTILE}",
        data={"source": DataRecord(f"data {HOSTILE}", "0a" * 32, 30)},
        clouds={"source": [*clouds, *clouds], f"target {HOSTILE}": clouds},
        mistakes={f"scan {HOSTILE}": clouds[1:], "source": clouds[:2]},
        nearest={"lone": clouds[:1]},
        maps=(
            FeatureMap(
                f"map {HOSTILE}",
                rng.normal(size=(9, 2)),
                np.arange(9) % 3,
                ("source",) * 5 + (f"target {HOSTILE}",) * 4,
            ),
        ),
        scores=(
            ScoreLine(
                name=f"line {HOSTILE}",
                network="dgcnn",
                data=f"a → b {HOSTILE}",
                selection="last",
                accuracy=mean_sem([0.5, 0.6]),
                class_mean_accuracy=mean_sem([0.4, 0.6]),
                class_names=names,
                confusion=np.pad(matrix, ((0, 0), (0, 1))),
                seeds=(0, 1),
                differs=f"theta {HOSTILE}",
                published="72.4 ± 0.8",
                choices={"last": mean_sem([0.5, 0.6]), "oracle": mean_sem([0.7, 0.8])},
                marks=("transductive", f"mark {HOSTILE}"),
            ),
        ),
        published_source=f"paper {HOSTILE}",
        curves=(Curve(f"loss {HOSTILE}", epochs, 1.0 / epochs),),
        marks=(2.0,),
        rounds=(
            SelectionRound(1, 0.8, np.array([5, 0, 3]), np.array([2, 0, 2]), 0.5),
            SelectionRound(2, 0.805, np.array([1, 0, 0]), np.zeros(3, int), None, HOSTILE),
        ),
        notes=(f"Note {HOSTILE}",),
    )


@pytest.fixture(scope="session")
def page_path(report, tmp_path_factory) -> Path:
    """The page, written once for all tests that only read it."""
    path = tmp_path_factory.mktemp("report") / "deep" / "report.html"
    write_report(path, report)
    return path


@pytest.fixture(scope="session")
def grid(tmp_path_factory) -> Path:
    """A folder with a source-only run, one that it warmed up, their data and their records."""
    from qs3.io import load_clouds, load_unlabelled
    from qs3.training import SelfTrainingSettings, TrainSettings, evaluate, fit

    folder = tmp_path_factory.mktemp("grid")
    rows = [(index % 3, "train", 32) for index in range(12)]
    data = write_store(folder / "shapes", ("bed", "chair", "sofa"), rows)
    settings = TrainSettings(model="pointnet", num_points=24, epochs=2, batch_size=6, threads=1)
    source, target = load_clouds(data), load_unlabelled(data)
    fit("source-only", source, None, settings, run_dir=folder / "first")
    rounds = SelfTrainingSettings(threshold=0.0, rounds=2, epochs=1)
    with warnings.catch_warnings():  # a network of two epochs may know one class alone
        warnings.simplefilter("ignore")
        fit("qbst", source, target, settings, rounds, run_dir=folder / "second",
            warm_up=folder / "first")  # fmt: skip
    for name in ("first", "second"):
        evaluate(folder / name, data)
    return folder
