"""Damaged files of every layout: read, or refused in one clear line; nothing else ever happens."""

import json
import subprocess
import sys
from pathlib import Path

import pytest

from .layouts import LAYOUTS

WORKER = Path(__file__).parent / "worker.py"
SAMPLES = 1000


def run(name: str, folder: Path, first: int, last: int) -> list[dict]:
    """Load damaged copies in a process of their own; a crash of it is one sample's end."""
    ends: list[dict] = []
    while first < last:
        command = [sys.executable, str(WORKER), name, str(folder), str(first), str(last)]
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        lines = [json.loads(line) for line in done.stdout.splitlines()]
        ends += [line for line in lines if "end" in line]
        if done.returncode == 0:
            break
        if not lines or "end" in lines[-1]:
            raise AssertionError(f"the worker failed outside a sample: {done.stderr[-2000:]}")
        crash = lines[-1] | {"end": f"process died: {done.returncode} {done.stderr[-300:]}"}
        ends.append(crash)
        first = crash["sample"] + 1
    return ends


def judge(ends: list[dict], count: int) -> None:
    assert len(ends) == count
    bad = [end for end in ends if end["end"] not in ("read", "refused")]
    assert not bad, "\n".join(json.dumps(end) for end in bad[:20])
    several = [end for end in ends if end.get("lines", 1) != 1]
    assert not several, "\n".join(json.dumps(end) for end in several[:5])
    # The damage has to matter: a loader that reads everything would not be tested at all.
    assert sum(end["end"] == "refused" for end in ends) > count / 10


@pytest.mark.parametrize("name", ["generated", "npz", "pointda10-h5", "mesh-off"])
def test_a_few_damaged_copies(name, tmp_path):
    judge(run(name, tmp_path, 0, 30), 30)


@pytest.mark.slow
@pytest.mark.parametrize("name", LAYOUTS)
def test_a_thousand_damaged_copies(name, tmp_path):
    judge(run(name, tmp_path, 0, SAMPLES), SAMPLES)
