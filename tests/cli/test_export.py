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
    settings = dataclasses.replace(SETTINGS, preparation=ROBUST)
    save_model(folder, model, ("bed", "lamp", "sofa"), settings)
    return folder, model


def test_export_writes_a_file_that_answers_as_the_run(qs3, network, tmp_path):
    import onnxruntime

    folder, model = network
    out = tmp_path / "new" / "shapes.onnx"
    done = qs3("export", folder, "--out", out)
    assert done.stdout.splitlines() == [str(out)]
    first, second = done.stderr.splitlines()
    assert "on 16 random clouds" in first
    assert "resample(cloud[distinct_inliers(cloud, True, 4096)], 32)" in second
    points = np.random.default_rng(0).normal(size=(2, 32, 3)).astype(np.float32)
    session = onnxruntime.InferenceSession(out, providers=["CPUExecutionProvider"])
    (found,) = session.run(None, {"points": points})
    how = dataclasses.replace(ROBUST, remove_outliers=False, redraw=False)
    wanted = predict_probabilities(model, points, preparation=how)
    np.testing.assert_allclose(found, wanted, rtol=0, atol=1e-5)


def test_export_keeps_what_it_did_not_write(qs3, network, tmp_path):
    other = tmp_path / "other.onnx"
    other.write_text("precious")
    line = qs3.refuses("export", network[0], "--out", other)
    assert "other.onnx: is not an export of qs3" in line
    assert other.read_text() == "precious"


def test_export_names_what_is_no_run(qs3, tmp_path):
    assert "no model.safetensors here" in qs3.refuses("export", tmp_path)
