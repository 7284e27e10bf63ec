"""The page "Your own parts", command by command, on twelve parts and six objects on a table."""

import shlex
from pathlib import Path

import pytest

from ..scripts import load_script

ROOT = Path(__file__).parents[2]


@pytest.fixture
def story():
    return load_script(ROOT / "benchmarks" / "own_parts.py")


def test_the_page_tells_the_whole_way(story):
    """Every verb of the way, in its order."""
    lines = [line.strip() for block in story.commands() for line in block.splitlines()]
    verbs = [shlex.split(line)[1] for line in lines if line.startswith("qs3 ")]
    assert list(dict.fromkeys(verbs)) == [
        "meshes", "generate", "info", "train", "capture", "segment", "predict", "watch", "evaluate",
        "report",
    ]  # fmt: skip


@pytest.mark.slow
def test_every_command_of_the_page_runs(story, tmp_path):
    """Twelve parts in four own classes, whose names stay; each part that was cut out is scored."""
    story.make(tmp_path)
    story.run(tmp_path)
    assert {p.name for p in (tmp_path / "sorted").iterdir()} <= {*story.CLASSES, "unknown"}
    assert (tmp_path / "runs" / "adapted" / "report.html").is_file()
    table = story.scores(tmp_path)
    assert set(table.reset_index()["class"]) == {*story.CLASSES, "cup"}
    assert (table["adapted"] <= table["cut_out"]).all()
