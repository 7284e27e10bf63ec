import subprocess
import sys

import pytest


class Command:
    """Runs ``qs3`` as a user does: in a process of its own."""

    def __call__(self, *arguments, code: int = 0, timeout: float = 300):
        done = subprocess.run(
            [sys.executable, "-m", "qs3", *map(str, arguments)],
            capture_output=True,
            text=True,
            timeout=timeout,
        )
        assert done.returncode == code, f"{done.returncode}: {done.stdout}\n{done.stderr}"
        return done

    def refuses(self, *arguments) -> str:
        """The one line with which the command refuses."""
        done = self(*arguments, code=2)
        assert done.stdout == ""
        lines = [line for line in done.stderr.splitlines() if "it/s" not in line and line.strip()]
        lines = [line for line in lines if "scan/s" not in line]
        assert len(lines) == 1, done.stderr
        assert lines[0].startswith("qs3: ")
        return lines[0]


@pytest.fixture(scope="session")
def qs3() -> Command:
    return Command()


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
        "--num-points", 128, *QUICK)  # fmt: skip
    return folder


@pytest.fixture(scope="session")
def run(qs3, store, tmp_path_factory):
    """A PointNet trained for a moment."""
    folder = tmp_path_factory.mktemp("runs") / "source-only"
    qs3("train", "--source", store, "--out", folder, "--model", "pointnet", "--num-points", 64,
        "--epochs", 2, "--batch-size", 5, "--threads", 1)  # fmt: skip
    return folder
