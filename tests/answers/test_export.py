"""Exported networks, run by onnxruntime, against PyTorch."""

import json
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest
import torch

from qs3.answers import to_onnx
from qs3.answers.to_onnx import export_run
from qs3.clouds.preparation import PAPER, ROBUST, distinct_inliers, resample
from qs3.errors import InputError, MissingExtraError, QS3Error
from qs3.models import create_model
from qs3.models.ops import farthest_point_sampling
from qs3.models.ops.sampling import _sample_in_a_loop
from qs3.models.wrappers import Aligned, Sized
from qs3.runs import TrainSettings, save_model
from qs3.training import load_model, predict_probabilities

from ..models.common import SMALL

OWN = replace(ROBUST, size_input=True, align=True)
CLASSES = ("Stuhl", "テーブル", 'a "lamp"')
TINY = "pointnet"
M = 40


def make_run(folder, name=TINY, preparation=PAPER):
    """A run whose network has moved statistics and decided answers."""
    torch.manual_seed(3)
    kind = name.split()[0]
    model = create_model(kind, len(CLASSES), **SMALL[name])
    for layer in model.modules():
        if isinstance(layer, (torch.nn.BatchNorm1d, torch.nn.BatchNorm2d)):
            torch.nn.init.uniform_(layer.weight, 0.3, 1)
    for _ in range(3):
        model(0.5 * torch.randn(8, M, 3))
    with torch.no_grad():
        list(model.parameters())[-2].mul_(8)
    if preparation.align:
        model = Aligned(model)
    if preparation.size_input:
        model = Sized(model, preparation.radius_share)
        torch.nn.init.normal_(model.size[2].weight)
    settings = TrainSettings(
        model=kind, model_settings=SMALL[name], num_points=M, preparation=preparation
    )
    save_model(folder, model.eval(), CLASSES, settings)
    return model


def clouds(b, n, seed=0):
    """Flat boxes far from the origin, in millimetres."""
    rng = np.random.default_rng(seed)
    return (1000 * rng.normal(size=(b, n, 3)) * [1, 0.5, 0.1] + 30_000).astype(np.float32)


def run_onnx(path):
    import onnxruntime

    session = onnxruntime.InferenceSession(path, providers=["CPUExecutionProvider"])
    return lambda points: session.run(["probabilities"], {"points": points})[0]


def facts_of(path):
    import onnx

    return json.loads({p.key: p.value for p in onnx.load(path).metadata_props}["qs3"])


def check(model, path):
    for b in (1, 3):
        points = clouds(b, M, seed=b)
        wanted, got = predict_probabilities(model, points), run_onnx(path)(points)
        assert (got.dtype, got.shape) == (np.float32, wanted.shape)
        np.testing.assert_allclose(got, wanted, rtol=0, atol=2e-5)


@pytest.fixture(scope="module")
def exported(tmp_path_factory):
    folder = tmp_path_factory.mktemp("run")
    return make_run(folder), export_run(folder).path


def test_the_file_gives_the_probabilities_of_pytorch(exported):
    check(*exported)


def test_the_file_names_classes_settings_and_the_shape_of_its_input(exported):
    import onnx

    facts = facts_of(exported[1])
    assert facts["class_names"] == list(CLASSES)
    assert facts["settings"]["train"]["num_points"] == M
    assert facts["expects"] == {
        "points": M, "distinct": False, "outliers_removed": False, "most": 4096
    }  # fmt: skip
    dims = onnx.load(exported[1]).graph.input[0].type.tensor_type.shape.dim
    assert [d.dim_param or d.dim_value for d in dims] == ["clouds", M, 3]


@pytest.mark.parametrize(
    "preparation",
    [
        pytest.param(OWN, id="sized"),
        pytest.param(
            replace(ROBUST, metric_unit=0.5, align=True), id="metric", marks=pytest.mark.slow
        ),
    ],
)
def test_the_way_of_docs_export_gives_the_answers_of_the_run(tmp_path, preparation):
    """Size in metres, a robust ball, outliers, and clouds with too many and too few points."""
    make_run(tmp_path, preparation=preparation)
    path = export_run(tmp_path).path
    run, expects = run_onnx(path), facts_of(path)["expects"]
    assert expects == {"points": M, "distinct": True, "outliers_removed": True, "most": 4096}
    answers = []
    for n in (M - 9, 3 * M):
        points = clouds(3, n, seed=n) / 1000
        points[:, 5] += 50
        wanted = predict_probabilities(load_model(tmp_path), points)
        for cloud, shares in zip(points, wanted, strict=True):
            kept = distinct_inliers(cloud, expects["outliers_removed"], expects["most"])
            assert len(kept) < n
            ready = resample(cloud[kept], expects["points"])[None]
            np.testing.assert_allclose(run(ready)[0], shares, rtol=0, atol=2e-5)
            answers.append(np.abs(run(16 * ready)[0] - shares).max())
    assert max(answers) > 1e-3  # sixteen times as large is another thing


@pytest.mark.parametrize("m", [1, 9, 40])
def test_the_loop_of_a_graph_samples_as_networks_do(m):
    points = torch.randn(3, 40, 3, generator=torch.Generator().manual_seed(0))
    points[:, 20:] = points[:, :20]
    start = torch.tensor([0, 7, 39])
    got = _sample_in_a_loop(points.permute(2, 0, 1).contiguous(), m, start)
    assert torch.equal(got, farthest_point_sampling(points, m, start))


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=pytest.mark.slow) for name in sorted(set(SMALL) - {TINY})]
)
def test_every_network_can_be_exported(name, tmp_path):
    model = make_run(tmp_path, name)
    # In its own process: the tests' check of types takes no symbol for an int.
    command = [sys.executable, "-m", "qs3", "export", str(tmp_path)]
    done = subprocess.run(command, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    check(model, tmp_path / "model.onnx")


def test_an_earlier_file_is_replaced_and_nothing_is_written_if_answers_differ(exported, tmp_path):
    other = make_run(tmp_path)
    with torch.no_grad():
        list(other.parameters())[-1].add_(torch.tensor([0.0, 0.5, 0.0]))
    data = exported[1].read_bytes()
    assert (to_onnx.compare(exported[0], M, PAPER, data) < to_onnx.ROUNDING).all()
    assert to_onnx.compare(other, M, PAPER, data).max() > to_onnx.STRAYS[1]
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(to_onnx, "_serialise", lambda *_: data)
        written = export_run(tmp_path).path
        earlier = written.stat().st_ino
        assert export_run(tmp_path).path.stat().st_ino != earlier
        assert written.read_bytes() == data
        settings = TrainSettings(model="pointnet", model_settings=SMALL[TINY], num_points=M)
        save_model(tmp_path, other, CLASSES, settings)
        with pytest.raises(QS3Error, match=r"new.onnx: not written: on \d+ of 16"):
            export_run(tmp_path, tmp_path / "new.onnx")
    assert not (tmp_path / "new.onnx").exists()


def test_unusable_places_and_runs_are_refused(tmp_path):
    make_run(tmp_path)
    (tmp_path / "folder.onnx").mkdir()
    faults = [
        ((tmp_path / "none",), "no model.safetensors here"),
        ((tmp_path, tmp_path / "a.pt2"), "ends in .onnx"),
        ((tmp_path, tmp_path / "folder.onnx"), "is a folder"),
    ]
    for arguments, message in faults:
        with pytest.raises(InputError, match=message):
            export_run(*arguments)


@pytest.mark.parametrize("package", ["onnx", "onnxscript", "onnxruntime"])
def test_a_missing_package_names_its_extra(package, tmp_path, monkeypatch):
    make_run(tmp_path)
    monkeypatch.setitem(sys.modules, package, None)
    with pytest.raises(MissingExtraError, match=f"{package}.*'export'"):
        export_run(tmp_path)
