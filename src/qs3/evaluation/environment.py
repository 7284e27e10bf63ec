"""Environment of a run: versions, hardware and commit, without importing torch."""

import platform
import re
import subprocess
from functools import cache
from pathlib import Path
from typing import Any

from qs3.processors import usable_processors
from qs3.store.manifest import package_versions

versions = package_versions
"""The versions of Python and of the packages that a result depends on."""


@cache
def hardware() -> dict[str, Any]:
    """Return ``cpu`` (model), ``cores`` (that this process may use) and ``gpus`` (names)."""
    query = ["nvidia-smi", "--query-gpu=name", "--format=csv,noheader"]
    listing = Path("/proc/cpuinfo")
    text = listing.read_text() if listing.is_file() else ""
    line = re.search(r"^model name\s*:\s*(.+)$", text, re.MULTILINE)
    return {
        "cpu": line[1].strip() if line else platform.processor() or platform.machine(),
        "cores": usable_processors(),
        "gpus": _output(query, Path.cwd()).splitlines(),
    }


def git_commit() -> str:
    """Return the commit of the source tree that this package runs from; empty if there is none.

    A tree with changes that are not committed gets ``-dirty`` after the commit.
    """
    here = Path(__file__).resolve().parent
    root = _output(["git", "rev-parse", "--show-toplevel"], here)
    # An installed package may lie inside some other repository, whose commit means nothing here.
    if not root or not (Path(root) / "src" / "qs3" / "evaluation" / Path(__file__).name).is_file():
        return ""
    commit = _output(["git", "rev-parse", "HEAD"], here)
    changed = _output(["git", "status", "--porcelain", "--untracked-files=no", "src"], Path(root))
    return f"{commit}-dirty" if commit and changed else commit


def _output(command: list[str], folder: Path) -> str:
    try:
        done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=20)
    except (OSError, subprocess.TimeoutExpired):
        return ""
    return done.stdout.strip() if done.returncode == 0 else ""
