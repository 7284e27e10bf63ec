"""CONTRIBUTING's tables of files are what the code asks for: an example of each is followed."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
TEXT = (ROOT / "CONTRIBUTING.md").read_text(encoding="utf-8")
SECTIONS = re.findall(r"^### (Add [^\n]+)\n+Example: (\w+)\.\n+((?:\|.*\n)+)", TEXT, re.MULTILINE)
# Who lists things of all kinds by choice: tables of runs, texts of help.
BY_CHOICE = ("src/qs3/paper/", "src/qs3/cli/")


@pytest.mark.parametrize(("title", "example", "table"), SECTIONS, ids=[s[0] for s in SECTIONS])
def test_a_new_thing_touches_the_files_that_are_listed(title, example, table):
    listed = {
        path.replace("<name>", example)
        for path in re.findall(r"^\| `([^`]+)`", table, re.MULTILINE)
    }
    for path in listed:
        assert (ROOT / path).is_file()
    word = re.compile(rf"\b{example}\b", re.IGNORECASE)
    mentioning = {
        str(path.relative_to(ROOT))
        for path in (ROOT / "src").rglob("*.*")
        if path.suffix in (".py", ".toml") and word.search(path.read_text(encoding="utf-8"))
    }
    unlisted = {path for path in mentioning - listed if not path.startswith(BY_CHOICE)}
    assert not unlisted
    assert listed <= mentioning | {path for path in listed if example in path}


def test_every_path_that_is_named_is_there():
    paths = re.findall(r"`((?:src|tests|docs|benchmarks)/[^`\s<>]+)`", TEXT)
    assert len(paths) > 8
    for path in paths:
        assert (ROOT / path).exists(), path


def test_every_picture_has_a_command_that_makes_it():
    rows = re.findall(r"^\| ([a-z, -]+) \| `python (\S+)[^`]*` \|$", TEXT, re.MULTILINE)
    named = [name for names, _ in rows for name in names.split(", ")]
    assert sorted(named) == sorted(path.stem for path in (ROOT / "docs/images").iterdir())
    for _, script in rows:
        assert (ROOT / script).is_file()
