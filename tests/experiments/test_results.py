"""The tables in results/ are what their records say: nothing in them is written by hand."""

import csv
import dataclasses
import importlib
import json
import re
from collections.abc import Sequence
from pathlib import Path
from statistics import fmean, stdev
from typing import Any

import pytest

from qs3 import structure
from qs3.evaluation.records import read_record
from qs3.experiments import TABLES, runs, scales, setup
from qs3.experiments.experiment import load_experiment
from qs3.experiments.figures import draw
from qs3.experiments.setup import read_setup
from qs3.experiments.table import FilledTable, Table
from qs3.experiments.text import FORMATS
from qs3.training import config, run

ROOT = Path(__file__).parents[2]
FOLDERS = sorted(path.parent for path in (ROOT / "results").glob("*/bench.json"))
RECORDS = [path for folder in FOLDERS for path in sorted((folder / "results").glob("*.json"))]
FILES = [path for folder in FOLDERS for path in sorted(folder.glob("*.csv"))]


def filled_like(path: Path) -> FilledTable:
    """The table with the rows and columns that the file has."""
    with path.open(encoding="utf-8") as handle:
        lines = list(csv.DictReader(handle))
    rows, columns = (tuple({line[name] for line in lines}) for name in ("row", "column"))
    name = next(name for name in sorted(TABLES, key=len) if path.stem.startswith(name))
    return Table(name, read_setup(path.parent), rows, columns).read()


def rows_of(text: str) -> list[list[str]]:
    return [line.strip("| ").split(" | ") for line in text.splitlines() if line.startswith("| ")]


@pytest.mark.parametrize("path", FILES, ids=[f"{p.parent.name}-{p.stem}" for p in FILES])
def test_a_table_is_what_its_records_say(path):
    filled = filled_like(path)
    assert filled.faults == ()
    committed = path.read_text(encoding="utf-8").splitlines()
    assert list(csv.DictReader(FORMATS["csv"](filled).splitlines())) == list(
        csv.DictReader(committed)
    )
    text = path.with_suffix(".md").read_text(encoding="utf-8")
    assert rows_of(FORMATS["md"](filled)) == rows_of(text)
    assert draw(filled).axes


def test_every_record_is_of_a_run_of_a_table():
    for folder in FOLDERS:
        names = set()
        for name in TABLES:
            filled = Table(name, read_setup(folder)).read()
            assert filled.faults == ()
            names |= set(filled.records)
        assert names == {path.stem for path in (folder / "results").glob("*.json")}


def wider(kind: type, modules: Sequence[Any], patch: pytest.MonkeyPatch, **types: type) -> type:
    """Add a setting to a dataclass, as a later version may; its modules see the wider one."""
    fields = [(name, inner, dataclasses.field()) for name, inner in types.items()]
    if kind is scales.Scale:  # a default goes on standing where there is one
        fields = [(name, inner, dataclasses.field(default=None)) for name, inner in types.items()]
    fields.append(("novelty", float, dataclasses.field(default=0.5)))
    made = dataclasses.make_dataclass(kind.__name__, fields, bases=(kind,), frozen=True)
    for module in modules:
        patch.setattr(module, kind.__name__, made)
    return made


def test_a_setting_that_is_added_leaves_all_records_readable(monkeypatch):
    for name in TABLES:
        load_experiment(name)  # before its module could see a wider scale
    train = wider(config.TrainSettings, (config, run, scales), monkeypatch)
    rounds = wider(config.SelfTrainingSettings, (config, run), monkeypatch)
    scale = wider(scales.Scale, (scales, setup), monkeypatch, train=train)
    wider(setup.Marker, (setup,), monkeypatch, scale=scale)
    presets = {
        name: rounds(**structure.unstructure(preset)) for name, preset in config.PRESETS.items()
    }
    monkeypatch.setattr(runs, "PRESETS", presets)
    count = 0
    for folder in FOLDERS:
        place = read_setup(folder)
        assert place.scale.novelty == 0.5
        for name in TABLES:
            filled = Table(name, place).read()
            assert filled.faults == ()
            for record in filled.records.values():
                assert record.settings["train"]["novelty"] == 0.5
                count += 1
    assert count >= len(RECORDS) > 20  # some stand in several tables
    for path in sorted((ROOT / "results" / "real").glob("*.json")):
        read_record(path)


def test_the_networks_page_shows_what_the_records_of_modelnet10_say():
    text = (ROOT / "docs" / "models.md").read_text(encoding="utf-8")
    part = text.partition("## ModelNet10")[2].partition("\n## ")[0]
    records = sorted((ROOT / "results" / "modelnet10").glob("*.json"))
    assert {path.stem for path in records} == set(re.findall(r"^\| `([\w-]+)` \|", part, re.M))
    for path in records:
        record = read_record(path)
        scores = (record.scores.accuracy, record.scores.class_mean_accuracy)
        shown = " | ".join(f"{100 * value:.1f}" for value in scores)
        assert record.model == path.stem and record.test.clouds == 908
        assert f"| `{path.stem}` | {shown} | 1 |" in part


def test_records_hold_no_path_of_a_machine():
    for path in sorted((ROOT / "results").rglob("*.json")):
        text = path.read_text(encoding="utf-8")
        assert not re.search(r'"/[a-z]+/', text), path
        json.loads(text)


def test_what_docs_say_of_unknown_objects_is_what_was_measured():
    page = (ROOT / "docs" / "real.md").read_text(encoding="utf-8")
    for path in sorted((ROOT / "results" / "unknown").glob("*.json")):
        told = json.loads(path.read_text(encoding="utf-8"))
        for score in told["scores"].values():
            before, after = (
                f"{100 * score[name]:.1f}"
                for name in ("accuracy_of_known", "accuracy_of_known_not_refused")
            )
            aurocs = f"| {score['auroc_simulated']:.2f} | {score['auroc']:.2f} |"
            refused = f" {score['refused_known']:.0%} | {score['refused_unknown']:.0%} |"
            assert f"{aurocs}{refused.replace('%', ' %')} {before} → {after} |" in page


def test_what_docs_say_of_views_is_what_was_measured():
    page = (ROOT / "docs" / "real.md").read_text(encoding="utf-8")
    folder = ROOT / "results" / "views-on-real"
    means = []
    for source in ("V1", "S", "M"):
        records = [read_record(path) for path in sorted(folder.glob(f"{source}_seed-*.json"))]
        assert {record.test.split for record in records} == {"strict-dev"} and len(records) == 3
        values = [100 * record.scores.accuracy for record in records]
        means.append(f"{fmean(values):.1f} ± {stdev(values) / 3**0.5:.1f}")
    one, five, surfaces = means
    text = f"{one} % on the first part of NYU from one view, {five} fused from five all around and "
    assert text + f"{surfaces} as surfaces" in " ".join(page.split())


def test_readme_says_of_views_and_rounds_what_was_measured():
    def mean(folder: str, names: str) -> float:
        paths = sorted((ROOT / "results" / folder).glob(names))
        assert len(paths) == 3
        return 100 * fmean(read_record(path).scores.accuracy for path in paths)

    def rounds(row: str) -> float:
        return mean("laptop/results", f"S-D_{row}_seed-*.json") - five

    one = mean("laptop/results", "V1-D_ordinary_seed-*.json")
    five = mean("laptop/results", "S-D_ordinary_seed-*.json")
    real = [mean("views-on-real", f"{source}_seed-*.json") for source in ("V1", "S")]
    paths = (ROOT / "results" / "laptop" / "results").glob("S-D_qbst-paper_seed-*.json")
    kept = fmean(sum(read_record(path).rounds[-1]["kept"]) for path in paths)
    gains = [rounds(row) for row in ("spst", "qbst-gentle", "qbst-paper", "defrec")]
    surface, clean, noisy = (mean("laptop/results", f"{s}-D_ordinary_seed-*.json") for s in "MCJ")
    page = " ".join((ROOT / "README.md").read_text(encoding="utf-8").split())
    for text in (
        f"({one:.1f} against {five:.1f} % on simulated Kinect views, ",
        f"{real[0]:.1f} against {real[1]:.1f} % on real ones)",
        f"SPST adds {gains[0]:.1f} points, gentle rounds {gains[1]:.1f}, and QBST",
        f"loses {-gains[2]:.1f}, as its pool shrinks to {kept:.0f} clouds",
        f"DefRec changes nothing (−{-gains[3]:.1f})",
        f"from one side are {noisy - surface:.1f} points above surfaces",
        f"surface is worth {clean - surface:.1f} and noise {noisy - clean:.1f},",
    ):
        assert text in page, text


def test_real_tables_and_their_page_are_what_the_records_say(monkeypatch):
    folder = ROOT / "results" / "real"
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    made = importlib.import_module("real_tables")
    text = made.tables(folder)
    assert (folder / "tables.md").read_text(encoding="utf-8") == text
    for path in made.PAGES:
        page = path.read_text(encoding="utf-8")
        assert re.search(r"\bM\)? \|", page)
        assert made.filled(page, text) == page
