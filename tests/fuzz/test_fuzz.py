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


@pytest.fixture(scope="session")
def ends(tmp_path_factory, request) -> dict[str, dict]:
    """How every hand-made case that was asked for ends; all in one process."""
    asked = {item.callspec.params.get("name") for item in request.session.items
             if item.path == request.path and hasattr(item, "callspec")}  # fmt: skip
    names = [name for name in CASES if name in asked]
    found = attack(names, tmp_path_factory.mktemp("cases"), len(names))
    return {end["name"]: end for end in found}


@pytest.mark.parametrize(
    "name", [pytest.param(n, marks=[pytest.mark.slow] * case.slow) for n, case in CASES.items()]
)
def test_a_hand_made_case(name: str, ends: dict[str, dict]) -> None:
    assert ends[name]["kind"] in CASES[name].ends, ends[name]


def test_every_threat_has_its_test() -> None:
    text = (ROOT / "SECURITY.md").read_text()
    named = re.findall(r"`(tests/[\w/]+\.py)(?:::(\w+))?`", text)
    assert len(named) > 10
    for file, test in named:
        source = (ROOT / file).read_text()
        assert not test or re.search(rf"def {test}\(", source), f"{file}::{test} is not there"
