"""Fixtures for every test."""

import os

# Before PyTorch loads: test processes share the cores already, and threads that wait for each
# other's core make small networks several times slower.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("GOMP_SPINCOUNT", "1000")

from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
from hypothesis import settings

# A busy machine is no fault: laws are not timed.
settings.register_profile("untimed", deadline=None)
settings.load_profile("untimed")


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of the real meshes and scans; the test is skipped where it is not here."""
    named = os.environ.get("QS3_SHARED_DATA")
    if named:
        folder = Path(named)
        if not folder.is_dir():
            pytest.fail(f"QS3_SHARED_DATA names {folder}, which is no folder")
        return folder
    folder = Path(__file__).resolve().parents[2] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip("no real data here: set QS3_SHARED_DATA to the folder that holds it")
    return folder


@pytest.fixture
def rng() -> np.random.Generator:
    """A generator with a fixed seed, fresh for each test."""
    return np.random.default_rng(20220712)


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    """The module of cheap scans, importable by worker processes too (they inherit the path)."""
    monkeypatch.syspath_prepend(str(Path(__file__).parent / "store"))
    import qs3_fake_scan

    yield qs3_fake_scan
