"""Fixtures of the data set tests."""

from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import pytest


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    """The module of cheap scans, importable by worker processes too (they inherit the path)."""
    monkeypatch.syspath_prepend(str(Path(__file__).parent))
    import qs3_fake_scan

    yield qs3_fake_scan
