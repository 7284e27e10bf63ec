"""``qs3 view`` as a user calls it."""

import functools
import os
import signal
import socket
import subprocess
import sys
import urllib.request

import numpy as np
import pytest

from qs3 import shapes
from qs3.cli.view import _scan_page
from qs3.io import load_clouds
from qs3.io.ply import write_ply
from qs3.sensor.settings import ScanSettings
from qs3.training import load_model, predict_probabilities
from qs3.viewer.opening import open_exhibits, open_mesh
from qs3.viewer.scan_controls import with_controls

pytest.importorskip("viser", reason="viser is not installed: pip install 'qs3[view]'")


@pytest.fixture
def archive(tmp_path, rng):
    """Four labelled clouds."""
    path = tmp_path / "four.npz"
    points = rng.normal(size=(4, 32, 3)).astype(np.float32)
    np.savez(path, points=points, label=[0, 1, 0, 1], class_names=["bed", "chair"])
    return path


@pytest.fixture
def run(tmp_path):
    """A network that nobody has trained."""
    from qs3.training.checkpoint import new_model, save_model
    from qs3.training.config import TrainSettings

    settings = TrainSettings(model="pointnet", num_points=16)
    folder = tmp_path / "run"
    folder.mkdir()
    save_model(folder, new_model(settings, 2, 0), ("bed", "chair"), settings)
    return folder


@pytest.fixture
def refused(typed):
    """The one line of a refusal; no address is printed, as there is nothing to open."""
    return functools.partial(typed.refuses, "view", "--port", 0)


def test_faults_are_one_line(refused, archive, run, tmp_path):
    assert "absent.off: no such file" in refused(tmp_path / "absent.off")
    line = refused("toaster")
    assert "toaster" in line
    assert "chair" in line
    line = refused(archive, "--class-name", "sofa")
    assert "sofa" in line
    assert "bed, chair" in line
    assert "split 'test'" in refused(archive, "--split", "test")
    assert "--data" in refused(run)
    assert "gone.npz" in refused(run, "--data", tmp_path / "gone.npz")
    assert "--data goes with a run" in refused(archive, "--data", archive)
    assert "--data goes with a run" in refused("chair", "--data", archive)
    assert "nosuch" in refused("chair", "--sensor", "nosuch")
    assert "seed -1" in refused("chair", "--seed", -1)
    (tmp_path / "bad.obj").write_text("nonsense")
    assert "bad.obj" in refused(tmp_path / "bad.obj")
    (tmp_path / "bad.ply").write_text("nonsense")
    assert "bad.ply" in refused(tmp_path / "bad.ply")
    (tmp_path / "empty").mkdir()
    assert "empty" in refused(tmp_path / "empty")


def test_data_of_other_classes_than_the_run_is_refused(refused, run, tmp_path):
    path = tmp_path / "other.npz"
    np.savez(path, points=np.ones((1, 8, 3)), label=[0], class_names=["spoon"])
    line = refused(run, "--data", path)
    assert "other.npz" in line
    assert "spoon" in line


def test_a_port_in_use_is_named(typed, archive):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        line = typed.refuses("view", archive, "--port", port)
    assert f"--port {port}: Address already in use" in line


def test_without_viser_the_extra_is_named(refused, monkeypatch, archive):
    monkeypatch.setitem(sys.modules, "viser", None)
    assert "pip install 'qs3[view]'" in refused(archive)


def test_a_run_answers_for_each_cloud_and_labels_are_only_shown(run, archive, tmp_path):
    clouds = load_clouds(archive, num_points=16)
    expected = predict_probabilities(load_model(run).model, clouds.points)
    exhibits, answers = open_exhibits(str(run), str(archive), None, "points")
    np.testing.assert_allclose(answers.probabilities, expected, atol=1e-6)
    assert answers.truth.tolist() == [0, 1, 0, 1]
    assert exhibits.labels == ("bed", "chair", "bed", "chair")

    np.savez(tmp_path / "bare.npz", points=clouds.points)
    _, answers = open_exhibits(str(run), str(tmp_path / "bare.npz"), None, "points")
    assert answers.truth is None


def test_clouds_of_any_size_and_single_files_are_taken(caplog, tmp_path, rng):
    folder = tmp_path / "scans"
    folder.mkdir()
    for count in (10, 20):
        np.savetxt(folder / f"{count}.xyz", rng.normal(size=(count, 3)))
    exhibits, _ = open_exhibits(str(folder), None, None, "points")
    assert exhibits.points.shape == (2, 2048, 3)
    assert "several sizes" in caplog.text
    write_ply(folder / "cloud.ply", rng.normal(size=(7, 3)))
    for name, count in (("10.xyz", 10), ("cloud.ply", 7)):
        assert open_mesh(str(folder / name), None) is None
        exhibits, _ = open_exhibits(str(folder / name), None, None, "points")
        assert exhibits[0].clouds["points"].shape == (count, 3)


def test_a_mesh_is_scanned_with_the_settings_of_the_page(tmp_path):
    shapes.make("table", seed=1).export(tmp_path / "table.ply")
    camera = ScanSettings(variant="scalar_rgb", samples=1, views=1, num_points=64, seed=3)
    for what, draws in ((str(tmp_path / "table.ply"), 0), ("table", 100)):
        page = _scan_page(what, None, None, "", camera).keywords
        assert page["draws"] == draws
        item = page["scan"](with_controls(page["start"], {"object_size": 0.5}), 1)
        assert item.clouds["points"].shape == (64, 3)
        assert np.ptp(item.mesh.vertices, axis=0).max() == pytest.approx(0.5)
        assert np.isin(item.views["points"], 0).all()


def test_serves_until_ctrl_c(archive):
    # A shell's background jobs ignore the interrupt, and what they start inherits that.
    script = (
        "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); "
        "from qs3.cli import main; main()"
    )
    command = [sys.executable, "-c", script, "view", str(archive), "--port", "0"]
    # A process group of its own, so that the interrupt reaches this process alone.
    with subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, start_new_session=True,
        env=dict(os.environ, PYTHONWARNINGS=""),
    ) as process:  # fmt: skip
        try:
            address = process.stdout.readline().strip()
            port = int(address.rsplit(":", 1)[1].partition("/")[0])
            with urllib.request.urlopen(address, timeout=30) as page:  # noqa: S310
                assert page.status == 200
            process.send_signal(signal.SIGINT)
            out, err = process.communicate(timeout=60)
        finally:
            process.kill()
    assert process.returncode == 0
    assert out == ""  # the address was all
    assert err.endswith("stopped\n")
    assert "Traceback" not in err
    assert f"ssh -L {port}:localhost:{port} " in err
    with pytest.raises(OSError, match="refused"):
        socket.create_connection(("127.0.0.1", port), timeout=5)
