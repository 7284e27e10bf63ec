"""A small but complete report, hostile text included."""

import warnings
from pathlib import Path

import numpy as np
import pytest

from qs3.evaluation.records import Scores, score
from qs3.report.page import Cloud, Report, write_report
from qs3.report.plots import Curve
from qs3.runs.rounds import RoundRecord

from ..browser import Browser
from ..stores import write_store

HOSTILE = '</script><script>alert(\'x\')</script><img src="http://example.org/a.png" onerror="b()">'


def scored(matrix: np.ndarray, class_names) -> Scores:
    """Scores with this confusion matrix; a column more than classes is an answer outside them."""
    true, answers = (np.repeat(index.ravel(), matrix.ravel()) for index in np.indices(matrix.shape))
    return score(true, np.where(answers < len(class_names), answers, -1), class_names)


def a_round(index: int, kept: list[int], above: list[int], **more) -> RoundRecord:
    facts = {"agreement": None, "skipped": False, "single_class": False, "held_out": None}
    facts |= {"theta": 0.8 + 0.01 * index, "pool": 9, "losses": (), "seconds": 0.0} | more
    return RoundRecord(round=index, confident=tuple(above), kept=tuple(kept), **facts)


@pytest.fixture(scope="session")
def report() -> Report:
    rng = np.random.default_rng(20220712)
    names = ("bed", f"chair {HOSTILE}", "table")
    clouds = [
        Cloud(rng.normal(size=(50, 3)).astype(np.float32), name, f"qbst: {HOSTILE}")
        for name in names
    ]
    matrix = np.array([[6, 4, 0, 0], [5, 5, 0, 0], [0, 5, 4, 1]])
    epochs = np.arange(1, 5)
    return Report(
        title=f"Title {HOSTILE}",
        summary=f"Summary {HOSTILE}",
        class_names=names,
        scores={
            f"before {HOSTILE}": scored(matrix, names),
            f"after {HOSTILE}": scored(np.array([[10, 0, 0], [0, 10, 0], [0, 1, 9]]), names),
        },
        notes=(f"Note {HOSTILE}",),
        clouds={"source": [*clouds, *clouds], f"target {HOSTILE}": clouds},
        curves=(Curve(f"loss {HOSTILE}", epochs, 1.0 / epochs),),
        marks=(2.0,),
        rounds=(
            a_round(1, [2, 0, 2], [5, 0, 3], agreement=0.5),
            a_round(2, [0, 0, 0], [1, 0, 0], skipped=True),
        ),
        settings={"seed": 0, "sensor": {"views": 5, "name": HOSTILE}},
    )


@pytest.fixture(scope="session")
def page_path(report, tmp_path_factory) -> Path:
    """The page, written once for all tests that only read it."""
    path = tmp_path_factory.mktemp("report") / "deep" / "report.html"
    write_report(path, report)
    return path


@pytest.fixture(scope="package")
def browser(tmp_path_factory):
    browser = Browser(tmp_path_factory.mktemp("profile"))
    yield browser
    browser.close()


@pytest.fixture(scope="session")
def grid(tmp_path_factory) -> Path:
    """A folder with a source-only run, one that it warmed up, their data and their records."""
    from qs3.answers import evaluate
    from qs3.clouds.load import load_clouds, load_unlabelled
    from qs3.runs import SelfTrainingSettings, TrainSettings
    from qs3.training import fit

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
