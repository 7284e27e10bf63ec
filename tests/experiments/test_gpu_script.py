"""The command for the day a GPU is at hand, but for what it measures."""

import json
import os
import sys
import time
from pathlib import Path

import pytest

from ..scripts import load_script

FOLDER = Path(__file__).parents[2] / "benchmarks"


@pytest.fixture(scope="module")
def gpu():
    return load_script(FOLDER / "gpu.py")


def test_a_dry_run_tells_every_stage_with_a_command_that_parses(gpu, capsys, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["gpu.py", "--dry-run", "--cpu", "--tiny", "--out", "here"])
    assert gpu.main() == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.partition(":")[0] for line in lines[::2]] == list(gpu.STAGES)
    for name, line in zip(gpu.STAGES, lines[1::2], strict=True):
        _, script, *words = line.split()
        options = gpu.parse(words)
        assert Path(script).is_file() and options.stage == name
        assert options.cpu and options.tiny and options.out == Path("here")
    text = (FOLDER / "ray_rate.py").read_text(encoding="utf-8")
    for flag in ("sensor", "json", "meshes", "repeats", "variant"):
        assert f'"--{flag}"' in text
    assert os.access(FOLDER / "gpu.sh", os.X_OK)


def test_stages_fail_and_end_alone_and_what_is_done_stays(gpu, tmp_path, capsys, monkeypatch):
    script = tmp_path / "stage.py"
    script.write_text("import sys, time\nexec(sys.argv[1])\n")
    commands = {"machine": "pass", "tests": "raise SystemExit('no luck')", "scan": "time.sleep(99)"}
    monkeypatch.setattr(
        gpu, "command_of", lambda name, *_: [str(script), commands.get(name, "pass")]
    )
    monkeypatch.setattr(gpu, "GRACE", 0.0)
    monkeypatch.setattr(gpu.signal, "signal", lambda *_: None)  # pytest keeps its own
    stages = {name: (kind, 0.05) for name, (kind, _) in gpu.STAGES.items()}
    monkeypatch.setattr(gpu, "STAGES", stages)
    out = tmp_path / "gpu"
    monkeypatch.setattr(sys, "argv", ["gpu.py", "--cpu", "--out", str(out)])
    assert gpu.main() == 1
    ended = {name: json.loads((out / f"{name}.json").read_text())["status"] for name in stages}
    others = dict.fromkeys(stages, "done")
    assert ended == others | {"tests": "failed", "scan": "out of time"}
    assert "failed no luck" in (out / "summary.md").read_text()
    capsys.readouterr()
    commands.update(tests="pass", scan="pass")
    start = time.monotonic()
    assert gpu.main() == 0
    lines = capsys.readouterr().out.splitlines()
    assert [line.partition(",")[0] for line in lines[:4]] == [
        "machine: is done",
        "tests: done",
        "scan: done",
        "matching: is done",
    ]
    assert time.monotonic() - start < 10
