"""``qs3 export`` as a user runs it."""

import dataclasses

import numpy as np
import pytest
import torch

from qs3.io.preparation import ROBUST
from qs3.models import create_model
from qs3.training import TrainSettings, predict_probabilities, save_model

SETTINGS = TrainSettings(
    model="pointnet",
    model_settings={"channels": (8, 8, 16), "hidden": (8,), "transforms": False},
    num_points=32,
)


@pytest.fixture(scope="module")
def network(tmp_path_factory):
    """A run of a small network that has learnt nothing."""
    folder = tmp_path_factory.mktemp("network")
    torch.manual_seed(0)
    model = create_model("pointnet", 3, **SETTINGS.model_settings).eval()
    save_model(folder, model, ("bed", "lamp", "sofa"), SETTINGS)
    return folder, model


def test_export_writes_a_file_that_answers_as_the_run(qs3, network, tmp_path):
    import onnxruntime

    folder, model = network
    out = tmp_path / "new" / "shapes.onnx"
    done = qs3("export", folder, "--to", "onnx", "--out", out)
    assert done.stdout.splitlines() == [str(out)]
    assert len(done.stderr.splitlines()) == 1
    assert "on 28 random clouds" in done.stderr
    points = np.random.default_rng(0).normal(size=(2, 77, 3)).astype(np.float32)
    session = onnxruntime.InferenceSession(out, providers=["CPUExecutionProvider"])
    (found,) = session.run(None, {"points": points})
    wanted = predict_probabilities(model, points, num_points=32)
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-5)


def test_export_tells_what_has_to_go_before(qs3, network, tmp_path):
    settings = dataclasses.replace(SETTINGS, preparation=ROBUST)
    save_model(tmp_path, network[1], ("bed", "lamp", "sofa"), settings)
    done = qs3("export", tmp_path, "--to", "torch-export")
    assert "distinct_inliers(cloud, True, 4096)" in done.stderr.splitlines()[-1]


def test_export_keeps_what_it_did_not_write(qs3, network, tmp_path):
    other = tmp_path / "other.pt2"
    other.write_text("precious")
    line = qs3.refuses("export", network[0], "--to", "torch-export", "--out", other)
    assert "other.pt2: holds something else" in line
    assert other.read_text() == "precious"


def test_export_names_what_is_no_run(qs3, tmp_path):
    assert "no model.safetensors here" in qs3.refuses("export", tmp_path, "--to", "onnx")
