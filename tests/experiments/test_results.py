"""The tables in results/ are what their records say: nothing in them is written by hand."""

import json
import re
from pathlib import Path

import pytest
from qs3.experiments.paper import EXPERIMENTS, PaperTable

from qs3.experiments.figures import draw
from qs3.experiments.setup import read_setup

ROOT = Path(__file__).parents[2]
TABLES = [
    path
    for path in sorted((ROOT / "results").glob("*/*.md"))
    if path.stem in EXPERIMENTS and (path.parent / "bench.json").is_file()
]


def part_of(path):
    """The table with the lines and columns that the file has."""
    setup = read_setup(path.parent)
    experiment = EXPERIMENTS[path.stem]
    whole = PaperTable(experiment, setup)
    grid, faults = whole.grid()
    assert faults == []
    rows = {place[0] for place, cell in grid.cells.items() if cell.accuracies}
    columns = {place[1] for place, cell in grid.cells.items() if cell.accuracies}
    return PaperTable(experiment, setup, tuple(sorted(rows)), tuple(sorted(columns)))


@pytest.mark.parametrize("path", TABLES, ids=[f"{p.parent.name}-{p.stem}" for p in TABLES])
def test_a_table_is_what_its_records_say(path):
    part = part_of(path)
    grid, faults = part.grid()
    assert faults == []
    for kind in ("md", "csv", "tex"):
        assert path.with_suffix(f".{kind}").read_text(encoding="utf-8") == part.text(grid, kind)
    assert draw(grid).axes and path.with_suffix(".png").read_bytes()[1:4] == b"PNG"


def test_the_readme_shows_numbers_of_the_tables():
    text = (ROOT / "README.md").read_text(encoding="utf-8")
    tables = (ROOT / "results" / "bench" / "adaptation-bench.md").read_text(encoding="utf-8")
    parts = {part.partition("\n")[0]: part for part in tables.split("\n## ")}
    value = r"(\d+\.\d ± \d+\.\d \(n=\d\))"
    shown = re.findall(rf"^\| ([\w-]+) \| {value} \| {value} \|$", text, re.M)
    assert len(shown) > 4
    table = (ROOT / "results" / "laptop" / "ordinary.md").read_text(encoding="utf-8")
    cell = r"(\d+\.\d ± \d+\.\d) \((\d+\.\d)\)"
    networks = re.findall(rf"^\| ([\w+-]+) \| {cell} \| {cell} \|$", text, re.M)
    assert len(networks) == 4
    for name, surfaces, told, scans, also in networks:
        cells = rf"{surfaces} \(n=3\) \| {told} ± .* \| {scans} \(n=3\) \| {also} ±"
        line = rf"\| {re.escape(name)} \| {cells}"
        assert re.search(line, table)
    for row, surfaces, scans in shown:
        assert f"| {row} | {surfaces} |" in parts["M → D"]
        assert f"| {row} | {scans} |" in parts["S → D"]


def test_the_networks_page_shows_what_the_records_of_modelnet10_say():
    text = (ROOT / "docs" / "models.md").read_text(encoding="utf-8")
    part = text.partition("## ModelNet10")[2].partition("\n## ")[0]
    records = sorted((ROOT / "results" / "modelnet10").glob("*.json"))
    assert {path.stem for path in records} == set(re.findall(r"^\| `([\w-]+)` \|", part, re.M))
    for path in records:
        value = json.loads(path.read_text(encoding="utf-8"))
        scores = value["scores"]
        told = [f"{100 * scores[name]:.1f}" for name in ("accuracy", "class_mean_accuracy")]
        assert value["model"] == path.stem and value["test"]["clouds"] == 908
        assert f"| `{path.stem}` | {told[0]} | {told[1]} | 1 |" in part


def test_records_hold_no_path_of_a_machine():
    records = sorted((ROOT / "results").rglob("*.json"))
    assert records
    for path in records:
        assert not re.search(r'"/[a-z]+/', path.read_text(encoding="utf-8")), path
