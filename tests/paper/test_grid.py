"""Runs are made once, in their order, and taken up again after a stop or a fault."""

import importlib
import re
import shutil
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from qs3.cli.reproduce import ReproduceOptions
from qs3.cli.reproduce import reproduce as command
from qs3.errors import InputError
from qs3.evaluation.records import RECORDS, append_record, score
from qs3.paper import grid
from qs3.paper.cells import ORDINARY, PAPER, make_cell
from qs3.paper.domains import parse_data
from qs3.paper.grid import find_missing, find_result, make_records, run_grid
from qs3.paper.reproduce import choose_tables, reproduce
from qs3.paper.setup import Setup, claim, count_data, read_setup
from qs3.paper.table import Table
from qs3.paper.table_text import markdown
from qs3.store.executors import Failure

from .conftest import TINY, drop, make_tables, records_of, rewrite

COLUMNS = ("M-D", "S-D", "S-F")


def comparable(folder):
    return {
        name: (run.scores, [{**done, "seconds": 0, "cpu_seconds": 0} for done in run.rounds])
        for name, run in records_of(folder).items()
    }


def counting(monkeypatch):
    """Count the runs that are made."""
    counted: list[str] = []

    def make(cells, setup):
        counted.extend(cell.name for cell in cells)
        return make_records(cells, setup)

    monkeypatch.setattr(grid, "make_records", make)
    return counted


@pytest.mark.parametrize("gone", ["runs/S-D/qbst/seed-0", "runs"])
def test_only_missing_runs_are_made_again_with_the_same_numbers(finished, whole, monkeypatch, gone):
    lost = "S-D_qbst_seed-0"
    drop(finished, lost)
    shutil.rmtree(finished / gone)
    counted = counting(monkeypatch)
    rows = ("supervised", "ordinary", "qbst")
    make_tables(finished, ["uda"], rows, ("S-D",), (0,))
    # A network that others start from is made again, if only its record is there.
    assert counted == [lost] if gone != "runs" else ["S-D_ordinary_seed-0", lost]
    if gone == "runs":
        assert comparable(finished) == comparable(whole)
        return
    assert comparable(finished) == comparable(whole)
    for kind in ("csv", "tex"):
        name = f"uda.{kind}"
        assert (finished / name).read_bytes() == (whole / name).read_bytes()
    again, before = (
        # CPU minutes and seconds are a clock's.
        re.sub(r"\d+\.\d · (\d+\.\d|–) · ", "", (folder / "uda.md").read_text("utf-8"))
        for folder in (finished, whole)
    )
    assert again == before


def test_remade_data_that_differ_are_reported_before_a_training(finished, monkeypatch):
    def change(name, value):
        if name == "S-D_supervised_seed-0":
            value["test"]["checksum"] = "0" * 64
        return None if name == "S-D_qbst_seed-0" else value

    rewrite(finished, change)
    counted = counting(monkeypatch)
    with pytest.raises(
        InputError, match=r"records\.jsonl:\d+: read other data than .*data/target holds"
    ):
        make_tables(finished, ["uda"], ("supervised", "qbst"), ("S-D",), (0,))
    assert counted == []


def test_a_folder_of_other_settings_is_refused(finished):
    setup = Setup(finished, TINY, seeds=(0,), threads=2)
    for is_dry in (False, True):
        with pytest.raises(InputError, match="threads = 1, not 2"):
            reproduce(choose_tables(["ordinary"], setup), setup, print, dry_run=is_dry)


def test_a_dry_run_prints_counts_and_writes_nothing(small_scales, finished, capsys):
    shutil.rmtree(finished / "runs")
    (finished / RECORDS).unlink()
    before = sorted(finished.rglob("*"))
    options = ReproduceOptions(
        ("uda",), finished, "smoke", dry_run=True, methods=("qbst",), tasks=("M-D", "S-D")
    )
    assert command(options) == 0
    printed = capsys.readouterr().out
    # Two tasks, three seeds, and a warm-up each.
    assert re.search(r"30 scans of the source, 48 scans of the target; 12 runs, 12 of", printed)
    assert sorted(finished.rglob("*")) == before


def test_a_folder_keeps_its_number_of_steps(small_scales, tmp_path):
    scale = replace(TINY, optimiser_steps=6)
    choice = ["ordinary"], ("dgcnn",), ("M-D",), (0,)
    make_tables(tmp_path, *choice, scale=scale)
    assert read_setup(tmp_path).scale.optimiser_steps == 6
    (record,) = records_of(tmp_path).values()
    assert record.steps["total"] == 6
    text = (tmp_path / "ordinary.md").read_text()
    assert "Each network is trained for 6 steps, not for the scale's own number." in text
    options = ReproduceOptions(("ordinary",), tmp_path, "smoke", (6,), (0,), ("dgcnn",), ("M-D",))
    assert command(options) == 0
    drop(tmp_path, "M-D_ordinary@dgcnn_seed-0")
    assert " --steps 6" in markdown(Table("ordinary", read_setup(tmp_path)))
    with pytest.raises(InputError, match="optimiser_steps = 6, not 7"):
        command(replace(options, steps=(7,)))
    with pytest.raises(InputError, match="--steps 0"):
        command(replace(options, steps=(6, 0)))
    with pytest.raises(InputError, match="--seeds: name at least one"):
        command(replace(options, out=tmp_path / "none", seeds=()))
    assert not (tmp_path / "none").exists()


def test_rows_without_rounds_train_for_as_many_steps_as_those_with_them(small_scales, tmp_path):
    rows = ("qbst-gentle", "ordinary", "ordinary-18", "defrec-18")
    scale = replace(TINY, optimiser_steps=6, more_steps=(18,))
    make_tables(tmp_path, ["uda"], rows, ("M-D",), (0,), scale=scale)
    made = records_of(tmp_path)
    steps = {name: record.steps["total"] for name, record in made.items()}
    assert steps["M-D_source-only-steps-18_seed-0"] == steps["M-D_defrec-steps-18_seed-0"] == 18
    assert steps["M-D_ordinary_seed-0"] == 6
    text = (tmp_path / "uda.md").read_text()
    assert "| without adaptation, 18 steps |" in text
    for what in ("DefRec over no adaptation, 18 steps", "QBST, gentle rounds over no adaptation"):
        assert f"- {what}, M → D: " in text
    # A later command with other numbers adds their rows, and loses none.
    options = ReproduceOptions(
        *(("uda",), tmp_path, "smoke", (6, 12), (0,)),
        *(("ordinary-12",), ("M-D",)),
        workers=1,
    )
    assert command(options) == 0
    assert "| without adaptation, 12 steps |" in (tmp_path / "uda.md").read_text()
    assert command(replace(options, steps=(6,), methods=(), dry_run=True)) == 0
    setup = read_setup(tmp_path)
    assert setup.scale.more_steps == (18, 12)
    assert {"ordinary-12", "ordinary-18"} <= {row.key for row in Table("uda", setup).headings[0]}
    assert " --steps 6 18 12" in markdown(Table("uda", setup))


def test_folders_of_a_scale_share_scans_and_resume(small_scales, tmp_path, monkeypatch, capsys):
    monkeypatch.syspath_prepend(Path(__file__).parents[2] / "benchmarks")
    again = importlib.import_module("again")
    words = "ordinary --seeds 0 --methods dgcnn --tasks M-D --steps"
    make_tables(tmp_path / "made", ["ordinary"], ("dgcnn",), ("M-D",), (0,))
    (tmp_path / "again").mkdir()
    (tmp_path / "made" / "data").rename(tmp_path / "again" / "data-smoke")
    for steps in (6, 12):
        scale = replace(TINY, optimiser_steps=steps)
        claim(Setup(tmp_path / "kept" / f"smoke-{steps}", scale, threads=1, meshes="shapes"))
    monkeypatch.setattr(again, "RESULTS", tmp_path / "kept")
    monkeypatch.setattr(again, "PLAN", {f"smoke-{n}": (f"{words} {n}",) for n in (6, 12)})
    for _ in range(2):
        monkeypatch.setattr(
            "sys.argv", ["again.py", "--out", str(tmp_path / "again"), "--workers", "1"]
        )
        again.main()
        (six,), (twelve,) = (
            records_of(tmp_path / "again" / f"smoke-{n}").values() for n in (6, 12)
        )
        assert (six.steps["total"], twelve.steps["total"]) == (6, 12)
        assert six.source.checksum == twelve.source.checksum
        assert (tmp_path / "again" / "smoke-12" / "data").resolve().name == "data-smoke"
    assert "1 runs, 0 of them missing" in capsys.readouterr().err


@pytest.fixture
def few_trees(monkeypatch):
    monkeypatch.setattr("qs3.parts.forest.TREES", 30)


@pytest.mark.usefixtures("few_trees")
def test_a_forest_is_a_network_of_the_tables(finished):
    setup = Setup(finished, TINY, seeds=(3,))
    cell = make_cell(setup, source="S", target="D", row=ORDINARY, seed=3, network="forest")
    (record,) = make_records([cell], setup)
    append_record(finished / RECORDS, record)
    assert record.model == "forest" and record.scores.accuracy > 0.2
    assert find_result(cell, setup, grid.read_results(setup)[0]) is not None


@pytest.mark.usefixtures("few_trees")
@pytest.mark.parametrize("row", ["qbst", "spst"])
def test_a_forest_with_rounds_starts_from_no_network(finished, row):
    setup = Setup(finished, TINY, seeds=(3,))
    cell = make_cell(setup, source="S", target="D", row=row, seed=3, network="forest")
    assert find_missing([cell], setup) == [cell]
    (record,) = make_records([cell], setup)
    assert (record.model, record.method) == ("forest", row)
    assert record.rounds
    append_record(finished / RECORDS, record)
    assert find_missing([cell], setup) == []


def test_a_missing_shared_folder_is_reported(small_scales, tmp_path, monkeypatch):
    monkeypatch.setenv("QS3_SHARED_DATA", str(tmp_path / "typo"))
    with pytest.raises(InputError, match=r"QS3_SHARED_DATA: .*typo is no folder"):
        command(ReproduceOptions(("ordinary",), tmp_path / "out", "smoke", dry_run=True))


def test_galleries_show_procedural_shapes_alone(finished):
    make_tables(finished, [], seeds=(0,), galleries=True)
    names = sorted(path.name for path in (finished / "galleries").iterdir())
    assert names == ["D.png", "F.png", "M.png", "S.png"]


def test_data_of_the_user_takes_a_domain_s_place(whole, tmp_path):
    data, out = whole / "data", tmp_path / "own"
    parsed = parse_data([f"D={data / 'target'}", f"M={data / 'source'}:train:"])
    parsed = count_data(parsed, TINY)
    assert parsed["D"].stands_for == "" and parsed["M"].train.cloud == "surface"
    lines: list[str] = []
    make_tables(out, ["ordinary"], ("dgcnn",), ("M-D",), (0,), lines.append, data=parsed)
    assert "no scans; 1 runs" in lines[0]
    text = (out / "ordinary.md").read_text()
    assert "D: target" in text and "Stand-ins" not in text
    assert "Meshes:" not in text
    for changed, message in (
        (f"D={data / 'target'}:train:train", "data.D.test.split = test, not train"),
        (f"D={data / 'source'}", "no cloud of split 'test'"),
    ):
        with pytest.raises(InputError, match=message):
            other = parsed | count_data(parse_data([changed]), TINY)
            make_tables(out, ["ordinary"], ("dgcnn",), ("M-D",), (0,), data=other)
    again = read_setup(out)
    assert again.data["D"].train.cloud == "points" and again.seeds == (0,)
    assert [again.data[kind].train.count for kind in parsed] == [24, 30]
    filled = Table("ordinary", again, ("dgcnn",), ("M-D",))
    assert filled.faults == [] and filled.waiting == []


class Inline:
    """An executor that ends calls in the opposite order."""

    ahead = 9

    def __init__(self, fail=""):
        self.calls, self.order, self.fail = [], [], fail

    def submit(self, key, function, *arguments):
        self.calls.append((key, function, arguments))

    def next(self):
        key, function, arguments = self.calls.pop()  # the last first
        self.order.append(str(key))
        if str(key) == self.fail:
            return key, Failure("ProcessDied", "no memory left")
        return key, function(*arguments)

    def __enter__(self):
        return self

    def __exit__(self, *exception):
        return None


PLACES = (("D", ORDINARY, ""), ("F", ORDINARY, ""), ("D", PAPER, ""), ("D", ORDINARY, "dgcnn"))


def cells_of(setup):
    return [
        make_cell(setup, source="S", target=target, row=row, network=network, seed=seed)
        for seed in setup.seeds
        for target, row, network in PLACES
    ]


def run_all(out, executor, report=lambda line: None, seeds=(0,)):
    setup = Setup(out, TINY, seeds=seeds)
    return run_grid(cells_of(setup), setup, report, executor)


@pytest.fixture
def ready_made(whole, monkeypatch):
    record = records_of(whole)["S-D_ordinary_seed-0"]

    def make(cells, setup):
        return [replace(record, experiment=cell.fields, seed=cell.seed) for cell in cells]

    monkeypatch.setattr(grid, "make_records", make)


def test_a_warm_up_is_waited_for_a_folder_is_one_call_and_a_seed_ends_before_the_next(
    ready_made, tmp_path
):
    executor = Inline()
    assert run_all(tmp_path, executor, seeds=(0, 1)) == []
    assert executor.order == [
        f"runs/{place}/seed-{seed}"
        for seed in (0, 1)
        for place in ("S/ordinary@dgcnn", "S/ordinary", "S-D/qbst-paper")
    ]
    assert len(records_of(tmp_path)) == 2 * len(PLACES)


def test_an_existing_record_stays_and_another_result_is_reported(ready_made, whole, tmp_path):
    kept = records_of(whole)["S-D_ordinary_seed-0"]
    other = replace(kept, scores=score(np.array([0, 1]), np.array([0, 0]), ("chair", "table")))
    path, lines, cells = tmp_path / RECORDS, [], cells_of(Setup(tmp_path, TINY, seeds=(0,)))
    for cell, record in zip(cells[:2], (other, kept), strict=True):
        append_record(path, replace(record, experiment=cell.fields))
    before = path.read_bytes()
    assert run_all(tmp_path, Inline(), lines.append) == []
    assert path.read_bytes().startswith(before) and len(records_of(tmp_path)) == len(PLACES)
    (line,) = [line for line in lines if "stays" in line]
    assert f"{path}:1: S-D_ordinary_seed-0 stays, with an accuracy of 50.0%" in line


def test_a_failed_training_is_named_and_others_stay(ready_made, tmp_path):
    failed = run_all(tmp_path, Inline(fail="runs/S/ordinary/seed-0"))
    assert failed[0] == "runs/S/ordinary/seed-0: ProcessDied: no memory left"
    # What starts from it cannot be made either.
    assert [line.partition(":")[0] for line in failed[1:]] == ["runs/S-D/qbst-paper/seed-0"]
    assert list(records_of(tmp_path)) == ["S-D_ordinary@dgcnn_seed-0"]


@pytest.mark.slow
def test_several_at_once_give_the_same_numbers(finished, whole):
    shutil.rmtree(finished / "runs")
    (finished / RECORDS).unlink()
    setup = Setup(finished, TINY, seeds=(0,), threads=1)
    with pytest.raises(InputError, match="--workers 0"):
        reproduce([], setup, print, workers=0)
    reproduce(choose_tables(["thresholds"], setup), setup, print, workers=2)
    found, wanted = comparable(finished), comparable(whole)
    assert len(found) == 8 and found == {name: wanted[name] for name in found}


_KILLED = """
import runpy, sys
from pathlib import Path
conftest = runpy.run_path({conftest!r})
conftest["make_tables"](Path(sys.argv[1]), ["thresholds"], seeds=(0,))
"""


@pytest.mark.slow
def test_a_killed_grid_continues_with_the_same_numbers(finished, whole):
    shutil.rmtree(finished / "runs")
    (finished / RECORDS).unlink()
    script = _KILLED.format(conftest=str(Path(__file__).parent / "conftest.py"))
    kept: set[str] = set()
    for count in (1, 4, 8):
        with subprocess.Popen([sys.executable, "-c", script, str(finished)]) as running:
            while running.poll() is None and len(records_of(finished)) < count:
                time.sleep(0.01)
            if count < 8:
                running.kill()
        found = set(records_of(finished))
        assert kept <= found
        kept = found
    assert running.returncode == 0
    found, wanted = comparable(finished), comparable(whole)
    assert len(found) == 8 and found == {name: wanted[name] for name in found}
