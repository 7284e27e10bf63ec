"""``qs3 view``: what it reads, where it puts clouds, and the page on a real viser server."""

import os
import signal
import socket
import subprocess
import sys
import urllib.request

import numpy as np
import pytest

from qs3.clouds.ply_writer import write_ply
from qs3.errors import InputError, MissingExtraError
from qs3.report.view import Items, open_items, place, serve
from qs3.runs.settings import TrainSettings
from qs3.runs.weights import new_model, save_model
from qs3.training import load_model, predict_probabilities

from ..browser import until
from ..stores import write_store


@pytest.fixture
def archive(tmp_path, rng):
    """Four labelled clouds."""
    path = tmp_path / "four.npz"
    points = rng.normal(size=(4, 32, 3)).astype(np.float32)
    np.savez(path, points=points, label=[0, 1, 0, 1], class_names=["bed", "chair"])
    return path


@pytest.fixture
def run(tmp_path):
    """An untrained network."""
    settings = TrainSettings(model="pointnet", num_points=16)
    folder = tmp_path / "run"
    folder.mkdir()
    save_model(folder, new_model(settings, 2, 0), ("bed", "chair"), settings)
    return folder


def test_a_store_has_scans_twins_and_surfaces_and_a_file_one_cloud(tmp_path, rng):
    rows = [(0, "train", 5), (1, "test", 6), (1, "train", 7)]
    folder = write_store(tmp_path / "set", ("bed", "chair"), rows, shards=2)
    items = open_items(str(folder))
    assert list(items.clouds) == ["points", "clean", "surface"]
    assert [len(cloud) for cloud in items.clouds["clean"]] == [5, 6, 7]
    assert items.labels == ("bed", "chair", "chair")
    assert open_items(str(folder), split="test").names == ("o1#0",)
    write_ply(tmp_path / "cloud.ply", rng.normal(size=(7, 3)))
    one = open_items(str(tmp_path / "cloud.ply"))
    assert (one.names, one.labels, list(one.clouds)) == (("cloud.ply",), (), ["points"])


def test_a_run_answers_for_each_cloud_and_labels_are_only_shown(run, archive, tmp_path):
    with np.load(archive) as arrays:
        points = arrays["points"]
    items = open_items(str(run), str(archive))
    expected = predict_probabilities(load_model(run), points)
    answers = [items.answer(cloud) for cloud in items.listed]
    answers = [[shares["bed"], shares["chair"]] for shares in answers]
    np.testing.assert_allclose(answers, expected, atol=1e-6)
    assert items.labels == ("bed", "chair", "bed", "chair")
    assert "label: chair" in items.text(1)
    np.savez(tmp_path / "bare.npz", points=points)
    assert open_items(str(run), str(tmp_path / "bare.npz")).labels == ()


def test_clouds_stand_side_by_side_in_one_scale(rng):
    first, second = place([rng.random((50, 3)) * 40 + 1000, rng.random((9, 3)) * 20 + 1010])
    assert np.ptp(first, axis=0).max() == pytest.approx(1, rel=0.1)
    assert np.ptp(second, axis=0).max() < 0.6
    assert first[:, 0].max() < second[:, 0].min()


def test_names_are_escaped():
    items = Items(("<img src=x>",), {"points": [np.ones((2, 3))]}, ("<b>",))
    assert "<img" not in items.text(0)
    assert "&lt;b&gt;" in items.text(0)


def test_unreadable_data_and_missing_options_are_refused(run, archive, tmp_path):
    for folder, word in (
        ((str(tmp_path / "absent.ply"),), "absent.ply: no such file"),
        ((str(run),), "--data"),
        ((str(archive), str(archive)), "--data goes with a run"),
        ((str(archive), None, "test"), "split 'test'"),
        ((str(run), str(tmp_path / "gone.npz")), "gone.npz"),
    ):
        with pytest.raises(InputError, match=word):
            open_items(*folder)


def test_buttons_step_through_the_objects_of_a_real_server(rng, capfd):
    pytest.importorskip("viser")
    clouds = rng.normal(size=(3, 20, 3)).astype(np.float32)
    clouds[2, 0] = np.nan
    kinds = {"points": list(clouds), "clean": list(clouds[:, :7])}
    items = Items(("a", "b", "c"), kinds, ("x", "y", "z"))
    with serve(items, 0) as (address, page):
        assert address.startswith("http://127.0.0.1:")
        with urllib.request.urlopen(address, timeout=30) as got:  # noqa: S310
            assert b"viser" in got.read().lower()
        assert "1 of 3: a" in page.text.content
        page.next.value = True
        until(lambda: "2 of 3: b" in page.text.content)
        page.previous.value = True
        until(lambda: page.row == 0)
        page.previous.value = True
        until(lambda: "3 of 3: c" in page.text.content)
        port = int(address.rpartition(":")[2])
    with pytest.raises(OSError, match="refused"):
        socket.create_connection(("127.0.0.1", port), timeout=5)
    assert capfd.readouterr().out == ""


def test_missing_viser_names_the_extra(monkeypatch):
    monkeypatch.setitem(sys.modules, "viser", None)
    items = Items(("a",), {"points": [np.ones((2, 3))]})
    with pytest.raises(MissingExtraError, match=r"\[view\]"), serve(items, 0):
        pass


def test_the_command_serves_until_ctrl_c(archive):
    pytest.importorskip("viser")
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
            with urllib.request.urlopen(address, timeout=30) as page:  # noqa: S310
                assert page.status == 200
            process.send_signal(signal.SIGINT)
            out, err = process.communicate(timeout=60)
        finally:
            process.kill()
    assert (process.returncode, out) == (0, "")
    assert "Traceback" not in err
