"""Hostile and damaged files: read, or refused in one clear line; nothing else ever happens."""

import re
from pathlib import Path

import pytest

from .attack import ROOT, attack
from .cases import CASES
from .layouts import LAYOUTS

QUICK = ("generated", "npz", "pointda10-h5", "mesh-off", "mesh-glb", "sensor")


def judge(ends: list[dict], count: int) -> None:
    assert len(ends) == count
    bad = [str(end) for end in ends if end["kind"] not in ("ok", "refused")]
    assert not bad, "\n".join(bad[:20])
    # The damage has to matter: a loader that reads everything would not be tested at all.
    assert sum(end["kind"] == "refused" for end in ends) > count / 5


def test_a_few_damaged_files(tmp_path: Path) -> None:
    judge(attack(QUICK, tmp_path, 60), 60)


@pytest.mark.slow
def test_many_damaged_files(tmp_path: Path) -> None:
    judge(attack(tuple(LAYOUTS), tmp_path, 1500, seed=1), 1500)


@pytest.mark.parametrize("slow", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_hand_made_cases(slow: bool, tmp_path: Path) -> None:
    names = [name for name, case in CASES.items() if case.slow == slow]
    ends = attack(names, tmp_path, len(names))
    bad = [str(end) for end in ends if end["kind"] not in CASES[end["name"]].ends]
    assert not bad, "\n".join(bad)


def test_every_threat_has_its_test() -> None:
    text = (ROOT / "SECURITY.md").read_text()
    named = re.findall(r"`(tests/[\w/]+\.py)(?:::(\w+))?`", text)
    assert len(named) > 10
    for file, test in named:
        source = (ROOT / file).read_text()
        assert not test or re.search(rf"def {test}\(", source), f"{file}::{test} is not there"
