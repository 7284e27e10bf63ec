import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from ..commands import refusal


class Command:
    """Runs ``qs3`` as a user does: in a process of its own (see ``server.py``)."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.count = folder, 0
        self.server = subprocess.Popen(
            [sys.executable, str(Path(__file__).parent / "server.py")],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            text=True,
        )

    def close(self) -> None:
        self.server.communicate()
        assert self.server.returncode == 0

    def __call__(self, *arguments, code: int = 0, timeout: float = 300):
        self.count += 1
        out, err = (self.folder / f"{self.count}.{name}" for name in ("out", "err"))
        asked = {
            "arguments": list(map(str, arguments)),
            "environment": dict(os.environ),
            "folder": str(Path.cwd()),
            "out": str(out),
            "err": str(err),
            "seconds": int(timeout),
        }
        assert self.server.stdin is not None
        assert self.server.stdout is not None
        self.server.stdin.write(json.dumps(asked) + "\n")
        self.server.stdin.flush()
        done = subprocess.CompletedProcess(
            arguments,
            int(self.server.stdout.readline()),
            out.read_text("utf-8"),
            err.read_text("utf-8"),
        )
        assert done.returncode == code, f"{done.returncode}: {done.stdout}\n{done.stderr}"
        return done

    def refuses(self, *arguments) -> str:
        """The one line with which the command refuses."""
        return refusal(self(*arguments, code=2))


@pytest.fixture(scope="session")
def qs3(tmp_path_factory):
    command = Command(tmp_path_factory.mktemp("said"))
    yield command
    command.close()


# The smallest scan that still runs through everything.
QUICK = ("--variant", "scalar_rgb", "--samples", "1", "--views", "1")


@pytest.fixture(scope="session")
def quick() -> tuple[str, ...]:
    return QUICK


# A quarter of the pixels of `paper`, with its f·b.
SMALL = """
base = "paper"
rig = { width = 540, height = 540, focal = 750.0, baseline = 0.2 }
matching = { num_disparities = 80, block_size = 11 }
depth = { stride = 2 }
"""


@pytest.fixture(scope="session")
def small(tmp_path_factory) -> tuple[str, ...]:
    """As ``quick``, with a camera of few pixels."""
    path = tmp_path_factory.mktemp("sensor") / "small.toml"
    path.write_text(SMALL)
    return (*QUICK, "--sensor", str(path))


@pytest.fixture(scope="session")
def store(qs3, small, tmp_path_factory):
    """Ten built-in shapes, scanned once each by the command."""
    folder = tmp_path_factory.mktemp("data") / "shapes"
    qs3("generate", "--meshes", "shapes", "--per-class", 1, "--out", folder, "--seed", 5,
        "--num-points", 128, "--workers", 0, *small)  # fmt: skip
    return folder


@pytest.fixture(scope="session")
def run(qs3, store, tmp_path_factory):
    """A PointNet trained for a moment."""
    folder = tmp_path_factory.mktemp("runs") / "source-only"
    qs3("train", "--source", store, "--out", folder, "--model", "pointnet", "--num-points", 64,
        "--epochs", 2, "--batch-size", 5, "--threads", 1)  # fmt: skip
    return folder
