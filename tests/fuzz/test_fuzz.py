"""Damaged files are read, or refused in one line."""

from pathlib import Path

import pytest

from .attack import GOOD, attack
from .kinds import KINDS

QUICK = ("generated", "npz", "h5", "ply", "pcd", "mesh-off", "mesh-glb", "sensor")


@pytest.mark.parametrize(
    ("kinds", "count"), [(QUICK, 80), pytest.param(tuple(KINDS), 1500, marks=pytest.mark.slow)]
)
def test_damaged_files_are_read_or_refused(
    kinds: tuple[str, ...], count: int, tmp_path: Path
) -> None:
    ends = list(attack(kinds, tmp_path, count, seed=1))
    assert [end for end in ends if end.end not in GOOD] == []
    # The damage has to matter: a loader that reads everything would not be tested at all.
    assert sum(end.end == "refused" for end in ends) > count / 5
