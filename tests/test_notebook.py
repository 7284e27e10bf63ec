"""The notebook runs from top to bottom, and its repository copy holds no output."""

import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
CELLS = json.loads((ROOT / "examples" / "qs3.ipynb").read_text("utf-8"))["cells"]
CODE = ["".join(cell["source"]) for cell in CELLS if cell["cell_type"] == "code"]


@pytest.mark.slow
def test_every_cell_runs_in_order(tmp_path):
    """In a process and a folder of its own; nothing is installed where qs3 is there."""
    script = tmp_path / "cells.py"
    script.write_text("\n".join(CODE), "utf-8")
    done = subprocess.run(
        [sys.executable, script], cwd=tmp_path, capture_output=True, text=True, timeout=600,
        env=os.environ | {"OMP_NUM_THREADS": "1"},
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert done.stdout.count(" taken for ") == 8
