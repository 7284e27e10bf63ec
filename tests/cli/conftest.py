import json
import os
import subprocess
import sys
from pathlib import Path

import pytest

from qs3.cli import main


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


class Typed:
    """Runs ``qs3`` in this process, which need not start; settings are checked by type here."""

    def __init__(self, capfd) -> None:
        self.capfd = capfd

    def __call__(self, *arguments, code: int = 0):
        self.capfd.readouterr()
        with pytest.raises(SystemExit) as ended:
            main([str(argument) for argument in arguments])
        done = subprocess.CompletedProcess(
            arguments, int(ended.value.code or 0), *self.capfd.readouterr()
        )
        assert done.returncode == code, done.stderr
        return done

    def refuses(self, *arguments) -> str:
        return refusal(self(*arguments, code=2))


def refusal(done) -> str:
    """The one line on standard error, bars of progress aside."""
    assert done.stdout == ""
    lines = [line for line in done.stderr.splitlines() if "it/s" not in line and line.strip()]
    lines = [line for line in lines if "scan/s" not in line and "scene/s" not in line]
    assert len(lines) == 1, done.stderr
    assert lines[0].startswith("qs3: ")
    return lines[0]


@pytest.fixture
def typed(capfd) -> Typed:
    return Typed(capfd)


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


@pytest.fixture(scope="session")
def store(qs3, tmp_path_factory):
    """Ten built-in shapes, scanned once each by the command."""
    folder = tmp_path_factory.mktemp("data") / "shapes"
    qs3("generate", "--meshes", "shapes", "--per-class", 1, "--out", folder, "--seed", 5,
        "--num-points", 128, "--workers", 0, *QUICK)  # fmt: skip
    return folder


@pytest.fixture(scope="session")
def run(qs3, store, tmp_path_factory):
    """A PointNet trained for a moment."""
    folder = tmp_path_factory.mktemp("runs") / "source-only"
    qs3("train", "--source", store, "--out", folder, "--model", "pointnet", "--num-points", 64,
        "--epochs", 2, "--batch-size", 5, "--threads", 1)  # fmt: skip
    return folder
