from pathlib import Path

import pytest

from qs3 import cli


def do(*words, code: int = 0) -> None:
    """Run ``qs3`` for a fixture that several tests share."""
    assert cli.run([str(word) for word in words]) == code


# The smallest scan that still runs through everything.
QUICK = ("--variant", "scalar_rgb", "--samples", "1", "--views", "1")


@pytest.fixture(scope="session")
def quick() -> tuple[str, ...]:
    return QUICK


# A sixteenth of the pixels of `paper`.
SMALL = """
base = "paper"
rig = { width = 270, height = 270, focal = 375.0, baseline = 0.2 }
matching = { num_disparities = 48, block_size = 9 }
depth = { stride = 1 }
"""


@pytest.fixture(scope="session")
def small(tmp_path_factory) -> tuple[str, ...]:
    """As ``quick``, with a camera of few pixels."""
    path = tmp_path_factory.mktemp("sensor") / "small.toml"
    path.write_text(SMALL)
    return (*QUICK, "--sensor", str(path))


@pytest.fixture(scope="session")
def store(small, tmp_path_factory) -> Path:
    """Ten built-in shapes, scanned once each by the command."""
    folder = tmp_path_factory.mktemp("data") / "shapes"
    do("generate", "--meshes", "shapes", "--per-class", 1, "--out", folder, "--seed", 5,
       "--num-points", 128, "--workers", 0, *small)  # fmt: skip
    return folder


@pytest.fixture(scope="session")
def run(store, tmp_path_factory) -> Path:
    """A PointNet trained for a moment."""
    folder = tmp_path_factory.mktemp("runs") / "source-only"
    do("train", "--source", store, "--out", folder, "--model", "pointnet", "--num-points", 64,
       "--epochs", 2, "--batch-size", 5, "--threads", 1)  # fmt: skip
    return folder
