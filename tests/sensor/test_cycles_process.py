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

from qs3.errors import InputError, MissingExtraError
from qs3.sensor.render import Body, LightSettings, Scene
from qs3.sensor.render.cycles import (
    CyclesRenderer,
    RenderError,
    _versions,
    find_cycles,
    interpreter,
)
from qs3.sensor.rig import Pose, Region, StereoRig

pytestmark = pytest.mark.skipif(os.name != "posix", reason="the stand-ins are POSIX programs")

RIG = StereoRig(width=32, height=24, focal=40.0)
POSE = Pose.looking_at(np.array([2.0, -3.0, 2.0]), np.zeros(3))
SCENE = Scene(
    (Body(trimesh.creation.box()),), LightSettings(), np.ones((4, 6), np.float32), 0.6, 0.5
)

# Answers as the worker does; a part of each image shows its seed.
STAND_IN = """
import json, os, pathlib, signal, subprocess, sys, time
import numpy as np
folder = pathlib.Path(sys.argv[-1])
request = json.loads((folder / "request.json").read_text())
BODY
for index, shot in enumerate(request["shots"]):
    x, y, w, h = shot["region"]
    np.save(folder / f"image-{index}.npy", np.full((h, w), shot["seed"], np.float32))
(folder / "answer.json").write_text(json.dumps({"background": 0.25}))
"""

# Blender's module as far as the real worker needs it to start; a rendering takes for ever.
BPY = """
import sys, time
from unittest.mock import MagicMock
bpy = MagicMock(name="bpy")
bpy.app.version_string = "4.2.0"
bpy.ops.render.render = lambda **_: time.sleep(600)
sys.modules["bpy"] = bpy
"""


@pytest.fixture
def stand_in(tmp_path, monkeypatch):
    """Make a program and name it as the Python of Cycles; no folder may stay behind."""

    def make(body: str = "pass") -> Path:
        path = tmp_path / "python"
        path.write_text(f"#!{sys.executable}\n{STAND_IN.replace('BODY', textwrap.dedent(body))}")
        path.chmod(path.stat().st_mode | stat.S_IXUSR)
        monkeypatch.setenv("QS3_CYCLES_PYTHON", str(path))
        return path

    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "temporary"))
    monkeypatch.delenv("QS3_BLENDER", raising=False)
    yield make
    assert not list((tmp_path / "temporary").iterdir())


@pytest.fixture
def stub_bpy(tmp_path, monkeypatch):
    """Name this Python, with a stub of Blender's module, as the Python of Cycles."""
    (tmp_path / "stub").mkdir()
    (tmp_path / "stub" / "bpy.py").write_text(BPY)
    (tmp_path / "temporary").mkdir()
    monkeypatch.delenv("QS3_BLENDER", raising=False)
    monkeypatch.setenv("QS3_CYCLES_PYTHON", sys.executable)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path / "stub"), prepend=os.pathsep)
    monkeypatch.setenv("TMPDIR", str(tmp_path / "temporary"))
    _versions.cache_clear()
    return tmp_path


def render(**settings):
    return CyclesRenderer(**settings).render(SCENE, RIG, [POSE], [0])


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
    assert first[0].background == 0.25
    assert not first[0].display
    assert render(view_transform="Filmic")[0].display


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        ("sys.stderr.write('out of luck'); sys.stderr.flush(); os._exit(3)", "code 3.*of luck"),
        ("os.kill(os.getpid(), signal.SIGSEGV)", "SIGSEGV"),
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


def test_a_hang_ends_with_the_whole_process_group(stand_in, tmp_path, monkeypatch):
    monkeypatch.setattr("qs3.sensor.render.cycles._START_SECONDS", 1.0)
    stand_in(
        f"""
        child = subprocess.Popen(["sleep", "600"])
        open({str(tmp_path / "child")!r}, "w").write(str(child.pid))
        print("thinking", file=sys.stderr, flush=True)
        time.sleep(600)
        """
    )
    with pytest.raises(RenderError, match=r"silent for 2 s.*thinking"):
        render(timeout=0.5)
    assert gone(int((tmp_path / "child").read_text()))


def test_a_program_that_does_not_start_is_named(stand_in):
    stand_in().write_text("#!/no/such/program\n")
    with pytest.raises(RenderError, match="does not start"):
        render()


def test_only_visible_regions_are_rendered(stand_in):
    stand_in()
    away = Pose.looking_at(np.array([2.0, -3.0, 2.0]), np.array([4.0, -6.0, -2.0]))
    pair = CyclesRenderer().render(SCENE, RIG, [away], [0], [Region(0, 0, 0, 0)])[0]
    assert pair.left.size == pair.right.size == 0
    given = CyclesRenderer().render(SCENE, RIG, [POSE], [0], [Region(3, 4, 5, 6)])[0]
    assert given.left.shape == given.right.shape == (6, 5)
    kinect = StereoRig(32, 24, 40.0, projector_offset=1.0, second="pattern")
    assert CyclesRenderer().render(SCENE, kinect, [POSE], [0])[0].right.size == 0
    whole = CyclesRenderer(full_frame=True).render(SCENE, RIG, [POSE], [0])[0]
    assert whole.left_region == RIG.full_frame


def test_the_interpreter_is_looked_up_in_order(tmp_path, monkeypatch):
    for name in ("QS3_BLENDER", "QS3_CYCLES_PYTHON"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(sys, "prefix", str(tmp_path / "env"))
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    assert interpreter() is None
    assert find_cycles() == {}
    with pytest.raises(MissingExtraError, match=r"make cycles.*'cycles'"):
        render()
    beside = tmp_path / "env-cycles" / "bin" / "python"
    beside.parent.mkdir(parents=True)
    beside.touch()
    assert (interpreter() or ())[0] == str(beside)
    monkeypatch.setattr("importlib.util.find_spec", lambda name: object())
    assert (interpreter() or ())[0] == sys.executable
    named = tmp_path / "python"
    monkeypatch.setenv("QS3_CYCLES_PYTHON", str(named))
    with pytest.raises(InputError, match="QS3_CYCLES_PYTHON"):
        interpreter()
    named.touch()
    assert (interpreter() or ())[0] == str(named)
    monkeypatch.setenv("QS3_BLENDER", str(beside))
    command = interpreter() or ()
    assert command[0] == str(beside)
    assert command[1] == "--background"
    assert command[-1] == "--"


def test_a_blender_program_serves_as_well(stub_bpy, monkeypatch):
    # As Blender does: eats its own options, runs the file behind --python, leaves the rest.
    blender = stub_bpy / "blender"
    blender.write_text(
        f"#!/bin/sh\nwhile [ $1 != --python ]; do shift; done\nshift\n"
        f'file=$1; shift; echo "Blender 4.2.0"; exec {sys.executable} "$file" "$@"\n'
    )
    blender.chmod(0o755)
    monkeypatch.setenv("QS3_BLENDER", str(blender))
    assert find_cycles() == {"command": str(blender), "blender": "4.2.0"} | {
        "python": sys.version.split()[0]
    }


def test_found_blender_is_reported_or_the_reason_against_it(stub_bpy, monkeypatch):
    assert find_cycles()["blender"] == "4.2.0"
    (stub_bpy / "stub" / "bpy.py").write_text(BPY.replace("4.2.0", "3.6.2"))
    _versions.cache_clear()
    with pytest.raises(RenderError, match=r"3\.6\.2 is too old: 4\.2"):
        find_cycles()
    monkeypatch.setenv("QS3_BLENDER", str(stub_bpy / "none"))
    with pytest.raises(InputError, match="QS3_BLENDER"):
        find_cycles()


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
            command = Path(f"/proc/{line}/cmdline").read_bytes().split(b"\0")
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
