"""A small but complete report, hostile text included."""

from pathlib import Path

import numpy as np
import pytest

from qs3.evaluation.metrics import mean_sem
from qs3.report import Cloud, DataLine, FeatureMap, Outcome, Report, ScoreLine, write_report
from qs3.report.montage import MontageView
from qs3.report.plots import Curve, SelectionRound

HOSTILE = '</script><script>alert(\'x\')</script><img src="http://example.org/a.png" onerror="b()">'


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
        before=Outcome(f"before {HOSTILE}", matrix),
        after=Outcome(f"after {HOSTILE}", np.array([[10, 0, 0], [0, 10, 0], [0, 1, 9]])),
        command=f"qs3 demo {HOSTILE}",
        settings={"seed": 0, "sensor": {"views": 5, "name": HOSTILE}},
        versions={"qs3": f"0.1.0 {HOSTILE}"},
        montage=MontageView(image, image, 30 / depth, depth, true, cloud, cloud, np.eye(16)),
        montage_title=f"mesh {HOSTILE}",
        data=(DataLine("source", f"data {HOSTILE}", 30, "0a" * 32),),
        clouds={"source": [*clouds, *clouds], f"target {HOSTILE}": clouds},
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
                confusion=matrix,
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
        agreement_meaning=f"Agreement {HOSTILE}",
        notes=(f"Note {HOSTILE}",),
    )


@pytest.fixture(scope="session")
def page_path(report, tmp_path_factory) -> Path:
    """The page, written once for all tests that only read it."""
    path = tmp_path_factory.mktemp("report") / "deep" / "report.html"
    write_report(path, report)
    return path
