"""The tables in results/ are what their records say: nothing in them is written by hand."""

import functools
import importlib
import json
import re
from dataclasses import replace
from pathlib import Path
from statistics import fmean, stdev

import pytest
import tyro

from qs3.cli.reproduce import ReproduceOptions
from qs3.evaluation.records import RECORDS, RunRecord, read_records
from qs3.paper import TABLES
from qs3.paper.cells import Cell
from qs3.paper.figures import draw
from qs3.paper.reproduce import choose_tables
from qs3.paper.scales import SCALES
from qs3.paper.setup import read_setup
from qs3.paper.table import Table
from qs3.paper.table_text import markdown

ROOT = Path(__file__).parents[2]
RESULTS = ROOT / "results"
FOLDERS = sorted(path.parent for path in RESULTS.glob("*/bench.json"))
FILES = [path for folder in FOLDERS for path in sorted(folder.glob("*.md"))]


@pytest.fixture(scope="module", autouse=True)
def read_once():
    """The files of results/ do not change."""
    with pytest.MonkeyPatch.context() as patch:
        for place in ("evaluation.records", "paper.grid", "paper.setup"):
            patch.setattr(f"qs3.{place}.read_records", read)
        yield


_read = functools.cache(read_records)


def read(path: Path) -> tuple[list, list]:
    records, faults = _read(path)
    return [*records], [*faults]


def records_in(folder: str) -> list[RunRecord]:
    records, faults = read(RESULTS / folder / RECORDS)
    assert faults == []
    return [record for _, record in records]


@pytest.mark.parametrize("path", FILES, ids=[f"{p.parent.name}-{p.stem}" for p in FILES])
def test_a_table_equals_its_records(path):
    filled = Table(path.stem, read_setup(path.parent)).with_records()
    assert filled.faults == []
    assert markdown(filled) == path.read_text(encoding="utf-8")
    if filled.experiment.columns[0].axis:
        assert draw(filled).axes


def test_every_record_is_of_a_run_of_a_table():
    for folder in FOLDERS:
        names = set()
        for name in TABLES:
            filled = Table(name, read_setup(folder))
            assert filled.faults == []
            names |= {cell.name for cell in filled.records}
        assert len(names) == len(records_in(folder.name))


def test_one_command_makes_all_records_again(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    again = importlib.import_module("again")
    assert again.PLAN.keys() == {folder.name for folder in FOLDERS}
    for folder, commands in again.PLAN.items():
        planned, names = set(), set()
        for words in commands:
            options = tyro.cli(ReproduceOptions, args=[*words.split(), "--out", folder])
            setup = replace(read_setup(RESULTS / folder), seeds=options.seeds)
            usual = SCALES[setup.scale.name].optimiser_steps
            assert (options.steps or (usual,))[0] == setup.scale.optimiser_steps
            assert {*options.steps[1:]} <= {*setup.scale.more_steps}
            names |= {*options.names}
            tables = choose_tables(options.names, setup, options.methods, options.tasks)
            cells = [cell for table in tables for cell in table.all_cells]
            planned |= {one.name for cell in cells for one in (cell, cell.warm_up) if one}
        assert {Cell(**one.experiment).name for one in records_in(folder)} <= planned, folder
        assert {path.stem for path in (RESULTS / folder).glob("*.md")} == names
    assert (RESULTS / "hours.md").read_text("utf-8") == again.hours()


def test_networks_page_equals_the_records_of_modelnet10():
    text = (ROOT / "docs" / "models.md").read_text(encoding="utf-8")
    part = text.partition("## ModelNet10")[2].partition("\n## ")[0]
    records = records_in("modelnet10")
    assert {one.model for one in records} == set(re.findall(r"^\| `([\w-]+)` \|", part, re.M))
    for record in records:
        scores = (record.scores.accuracy, record.scores.class_mean_accuracy)
        shown = " | ".join(f"{100 * value:.1f}" for value in scores)
        assert record.test.clouds == 908
        assert f"| `{record.model}` | {shown} | 1 |" in part


def test_records_hold_no_path_of_a_machine():
    for path in sorted(RESULTS.rglob("*.json*")):
        assert not re.search(r'"/[a-z]+/', path.read_text(encoding="utf-8")), path


def test_findings_on_unknown_objects_are_those_measured():
    page = (ROOT / "docs" / "real.md").read_text(encoding="utf-8")
    for path in sorted((ROOT / "results" / "unknown").glob("*.json")):
        score = json.loads(path.read_text(encoding="utf-8"))["scores"]["energy"]
        before, after = (
            f"{100 * score[name]:.1f}"
            for name in ("accuracy_of_known", "accuracy_of_known_not_refused")
        )
        aurocs = f"| {score['auroc_simulated']:.2f} | {score['auroc']:.2f} |"
        refused = f" {score['refused_known']:.0%} | {score['refused_unknown']:.0%} |"
        assert f"{aurocs}{refused.replace('%', ' %')} {before} → {after} |" in page


def test_differences_among_the_findings_are_those_of_the_tables():
    page = (ROOT / "docs" / "real.md").read_text(encoding="utf-8")
    tables = (RESULTS / "real" / "tables.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| (.+) \| (.+) \| (\S+) \((.+)\) \| (\d) \|$", page, re.M)
    assert len(rows) > 20
    for first, second, difference, interval, seeds in rows:
        row = f"| {first} | {second} | {difference} points (95 % interval {interval}, n={seeds}) |"
        assert row in tables, row


def matching(folder: str, **fields: str | int) -> list[RunRecord]:
    """The three records, one a seed, whose run has these fields."""
    changed = {"threshold", "step", "network", "steps"} - set(fields)
    found = [
        record
        for record in records_in(folder)
        if record.experiment is not None
        and fields.items() <= record.experiment.items()
        and not changed & record.experiment.keys()
    ]
    assert len({record.seed for record in found}) == len(found) == 3
    return found


def test_findings_on_views_are_those_measured():
    page = (ROOT / "docs" / "real.md").read_text(encoding="utf-8")
    means = []
    for source in ("V", "S", "M"):
        records = matching("views-on-real", source=source)
        assert {record.test.split for record in records} == {"strict-dev"} and len(records) == 3
        values = [100 * record.scores.accuracy for record in records]
        means.append(f"{fmean(values):.1f} ± {stdev(values) / 3**0.5:.1f}")
    one, five, surfaces = means
    text = f"{one} % with one view, {five} with five fused views, {surfaces} as surfaces"
    assert text in " ".join(page.split())


def test_page_equals_the_records_of_views_and_rounds():
    def mean(folder: str, **fields: str | int) -> float:
        return 100 * fmean(one.scores.accuracy for one in matching(folder, **fields))

    def on_d(source: str, row: str = "ordinary") -> float:
        return mean("laptop", source=source, target="D", row=row)

    one, five = on_d("V"), on_d("S")
    real = [mean("views-on-real", source=source) for source in ("V", "S")]
    paper = matching("laptop", source="S", target="D", row="qbst-paper")
    kept = fmean(sum(record.rounds[-1]["kept"]) for record in paper)
    gains = [on_d("S", row) - five for row in ("spst", "qbst-gentle", "qbst-paper", "defrec")]
    surface, clean, noisy = (on_d(source) for source in "MCJ")
    page = " ".join((ROOT / "docs" / "results.md").read_text(encoding="utf-8").split())
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


def test_real_tables_and_their_page_equal_the_records(monkeypatch):
    folder = ROOT / "results" / "real"
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    module = importlib.import_module("real_tables")
    text = module.tables(folder)
    assert (folder / "tables.md").read_text(encoding="utf-8") == text
    for path in module.PAGES:
        page = path.read_text(encoding="utf-8")
        assert re.search(r"\bM\)? \|", page)
        assert module.filled(page, text) == page


def test_table_of_rounds_against_as_many_steps_equals_the_records(monkeypatch):
    folder = RESULTS / "qbst"
    monkeypatch.syspath_prepend(ROOT / "benchmarks")
    module = importlib.import_module("qbst")
    text = (folder / "table.md").read_text(encoding="utf-8")
    assert module.table(folder) == text
    page = (RESULTS / "README.md").read_text(encoding="utf-8")
    section = page.partition("## QBST where there is a gap")[2].partition("\n## ")[0]
    quoted = re.findall(r"[+−][\d.]+\s\([+−][\d.]+\sto\s[+−][\d.]+\)", section)
    assert len(quoted) > 5
    for difference in quoted:
        assert " ".join(difference.split()).replace("−", "-") in text, difference


PAGES = {"results/README.md": 50, "docs/adaptation.md": 2, "docs/real.md": 30}
"""Pages, and the least number of figures with an interval on them. Means of NYU's views, on the
last of them, are of records without a table."""


@pytest.mark.parametrize("page", PAGES)
def test_every_figure_with_an_interval_on_a_page_is_of_a_table(page):
    def spaced(text: str) -> str:
        """Return one form: signs of ASCII, "12.3 (10.0 to 14.0)", no word between."""
        text = text.replace("−", "-").replace("–", " to ").replace(" points (95 % interval", " (")
        return re.sub(r"\(\s+", "(", " ".join(text.split()))

    def turned(figure: str) -> str:
        """Return the difference of second minus first."""
        mean, low, high = (-float(one) for one in re.findall(r"[+-]\d+\.\d", figure))
        return f"{mean:+.1f} ({high:+.1f} to {low:+.1f}"

    tables = spaced("".join(path.read_text("utf-8") for path in sorted(RESULTS.glob("*/*.md"))))
    text = spaced((ROOT / page).read_text(encoding="utf-8"))
    number = r"[+-]?\d+\.\d"
    means = "" if page == "docs/real.md" else r"|\d+\.\d ± \d\.\d"
    figures = re.findall(rf"{number} \({number} to {number}{means}", text)
    assert len(figures) >= PAGES[page]
    for figure in figures:
        known = figure in tables or (figure[0] in "+-" and turned(figure) in tables)
        assert known, figure
