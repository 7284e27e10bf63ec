"""The life of the renderer's child process, with small stand-ins for Blender."""

import os
import pickle
import signal
import stat
import subprocess
import sys
import textwrap
import time
from pathlib import Path

import numpy as np
import pytest
import trimesh

from qs3.errors import MissingExtraError
from qs3.sensor.light import Body, LightSettings, Scene
from qs3.sensor.light.cycles import CyclesRenderer, RenderError, find_cycles, interpreter
from qs3.sensor.rig import Pose, StereoRig

pytestmark = pytest.mark.skipif(os.name != "posix", reason="the stand-ins are POSIX programs")

RIG = StereoRig(width=32, height=24, focal=40.0)
POSE = Pose.looking_at(np.array([2.0, -3.0, 2.0]), np.zeros(3))
SCENE = Scene(
    (Body(trimesh.creation.box()),), LightSettings(), np.ones((4, 6), np.float32), 0.6, 0.5
)

# Answers as the worker does; a part of each image shows its seed.
STAND_IN = """
import json, os, pathlib, sys, time
import numpy as np
folder = pathlib.Path(sys.argv[-1])
request = json.loads((folder / "request.json").read_text())
BODY
for index, shot in enumerate(request["shots"]):
    x, y, w, h = shot["region"]
    np.save(folder / f"image-{index}.npy", np.full((h, w), shot["seed"], np.float32))
(folder / "answer.json").write_text("{}")
"""

# Blender's module as far as the real worker needs it to start; a rendering takes for ever.
BPY = """
import sys, time
from unittest.mock import MagicMock
bpy = MagicMock(name="bpy")
bpy.app.version_string = "4.5.0"
bpy.ops.render.render = lambda **_: time.sleep(600)
sys.modules["bpy"] = bpy
"""


@pytest.fixture
def stand_in(tmp_path, monkeypatch):
    """Make a program that stands in for the Python of Cycles; no folder may stay behind."""

    def make(body: str = "pass") -> Path:
        path = tmp_path / "python"
        path.write_text(f"#!{sys.executable}\n{STAND_IN.replace('BODY', textwrap.dedent(body))}")
        path.chmod(path.stat().st_mode | stat.S_IXUSR)
        monkeypatch.setattr("qs3.sensor.light.cycles.interpreter", lambda: str(path))
        return path

    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "temporary"))
    yield make
    assert not list((tmp_path / "temporary").iterdir())


@pytest.fixture
def stub_bpy(tmp_path, monkeypatch):
    """Give this Python a stub of Blender's module."""
    (tmp_path / "stub").mkdir()
    (tmp_path / "stub" / "bpy.py").write_text(BPY)
    (tmp_path / "temporary").mkdir()
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "stub"), prepend=os.pathsep)
    monkeypatch.setenv("TMPDIR", str(tmp_path / "temporary"))
    return tmp_path


def render():
    return CyclesRenderer().render(SCENE, RIG, [POSE], [0])


def gone(pid: int, within: float = 10.0) -> bool:
    for _ in range(int(within * 20)):
        try:
            state = Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0]
        except (FileNotFoundError, ProcessLookupError):
            return True
        if state == "Z":
            return True
        time.sleep(0.05)
    return False


def test_left_and_right_seeds_never_meet(stand_in):
    stand_in()
    first = CyclesRenderer().render(SCENE, RIG, [POSE, POSE], [3, 2**31 - 1])
    assert [pair.left[0, 0] for pair in first] == [6, np.float32(2**31 - 2)]
    assert [pair.right[0, 0] for pair in first] == [7, np.float32(2**31 - 1)]
    assert first[0].left.shape == (first[0].left_region.height, first[0].left_region.width)
    assert first[0].background == SCENE.light.ambient


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ("sys.stderr.write('out of luck'); sys.stderr.flush(); os._exit(3)", "code 3.*of luck"),
        ("os.abort()", "exit code -6"),
        ("raise RuntimeError('no such node')", "exit code 1.*no such node"),
        ("print('bye'); sys.exit()", "left no answer.*bye"),
    ],
)
def test_a_crash_fails_its_object_alone(stand_in, fault, words):
    stand_in(fault)
    with pytest.raises(RenderError, match=words) as caught:
        render()
    assert str(pickle.loads(pickle.dumps(caught.value))) == str(caught.value)  # noqa: S301
    stand_in()
    assert render()


def test_a_hang_ends(stand_in, monkeypatch):
    monkeypatch.setattr("qs3.sensor.light.cycles._START_SECONDS", 1.0)
    monkeypatch.setattr("qs3.sensor.light.cycles._SECONDS", 0.5)
    stand_in("print('thinking', file=sys.stderr, flush=True); time.sleep(600)")
    with pytest.raises(RenderError, match=r"silent for 2 s.*thinking"):
        render()


def test_the_interpreter_has_bpy_or_is_that_of_make_cycles(tmp_path, monkeypatch):
    monkeypatch.setattr(sys, "prefix", str(tmp_path / "env"))
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert interpreter() is None
    assert find_cycles() == {}
    with pytest.raises(MissingExtraError, match=r"make cycles.*'cycles'"):
        render()
    beside = tmp_path / "env-cycles" / "bin" / "python"
    beside.parent.mkdir(parents=True)
    beside.touch()
    assert interpreter() == str(beside)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: object())
    assert interpreter() == sys.executable


def start(*arguments: str) -> "subprocess.Popen[str]":
    return subprocess.Popen(
        [sys.executable, *arguments],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
    )


def worker_of(pid: int) -> int:
    """The child that renders, once it has been handed a scene."""
    for _ in range(1200):
        for line in Path(f"/proc/{pid}/task/{pid}/children").read_text().split():
            try:
                command = Path(f"/proc/{line}/cmdline").read_bytes().split(b"\0")
            except (FileNotFoundError, ProcessLookupError):  # another child, which has ended
                continue
            if any(word.endswith(b"_cycles_worker.py") for word in command):
                request = Path(command[-2].decode()) / "request.json"
                if request.exists() and "shots" in request.read_text():
                    return int(line)
        time.sleep(0.05)
    raise AssertionError("no worker was started")


# A shell that starts the tests in the background has its children ignore Ctrl-C: undone here.
CODE = """
import signal
signal.signal(signal.SIGINT, signal.default_int_handler)
from qs3.cli import main
main()
"""
SCAN = ("-c", CODE, "scan", "chair", "--renderer", "cycles", "--out")
RENDER = f"""
import sys
sys.path.insert(0, {str(Path(__file__).parent)!r})
from test_cycles_process import render
render()
"""
LINUX = pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="reads /proc of Linux")


@LINUX
def test_the_worker_leaves_when_its_parent_is_killed_while_it_renders(stub_bpy):
    parent = start("-c", RENDER)
    worker = worker_of(parent.pid)
    os.kill(parent.pid, signal.SIGKILL)
    parent.communicate()
    assert gone(worker)
    assert not list((stub_bpy / "temporary").iterdir())


@LINUX
def test_ctrl_c_leaves_neither_worker_nor_traceback(stub_bpy):
    parent = start(*SCAN, str(stub_bpy / "out"))
    worker = worker_of(parent.pid)
    os.killpg(parent.pid, signal.SIGINT)
    try:
        _, talk = parent.communicate(timeout=60)
    finally:
        parent.kill()
    assert parent.returncode == 130
    assert "Traceback" not in talk
    assert "stopped" in talk
    assert gone(worker)
    assert not list((stub_bpy / "temporary").iterdir())
