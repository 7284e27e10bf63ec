"""The bench resumes, refuses foreign records, and its table says what the records say."""

import csv
import dataclasses
import json
import re
import shutil

import numpy as np
import pytest
from qs3.experiments.adaptation_bench import Bench
from qs3.experiments.bench_data import choose_meshes, side_of
from qs3.experiments.bench_table import Line, Result, group_results, published
from qs3.experiments.rows import ABLATIONS, ROWS

from qs3 import shapes
from qs3.cli.reproduce import ReproduceOptions, reproduce
from qs3.errors import InputError
from qs3.evaluation.records import read_record
from qs3.experiments.cost import Counts, run_seconds
from qs3.experiments.runs import make_grid, make_run
from qs3.experiments.scales import SCALES
from qs3.experiments.setup import Setup

# So small a network may be sure of one class alone.
pytestmark = pytest.mark.filterwarnings("ignore:all .* confident clouds")
BOTH = ["S-D_qbst_seed-0.json", "S-D_source-only_seed-0.json"]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    return tmp_path_factory.mktemp("bench") / "whole"


@pytest.fixture
def finished(whole, make):
    make(whole, seeds=(0, 1))
    return whole


def copy(finished, tmp_path):
    return shutil.copytree(finished, tmp_path / "copy")


def scores(folder):
    found = {path.name: read_record(path) for path in sorted((folder / "results").iterdir())}
    return {name: (one.scores, one.choices) for name, one in found.items()}


def weights(folder):
    return {p.parent: p.read_bytes() for p in (folder / "runs").rglob("model.safetensors")}


def test_it_leaves_one_valid_record_a_run_and_a_titled_table(finished):
    assert sorted(p.name for p in (finished / "results").glob("*seed-0.json")) == BOTH
    text = (finished / "adaptation-bench.md").read_text()
    assert text.startswith("# *smoke* — Adaptation bench (procedural shapes only)")
    assert "A simulator on both sides flatters" in text
    assert "72.4 ± 0.8" in text and "64.0 ± 1.0" in text  # the paper's, beside
    assert "oracle \\*" in text and "an upper bound, not a rule" in text


def test_the_tables_numbers_are_those_of_the_records(finished):
    text = (finished / "adaptation-bench.md").read_text()
    for row in ("source-only", "qbst"):
        records = [
            json.loads((finished / "results" / f"S-D_{row}_seed-{seed}.json").read_text())
            for seed in (0, 1)
        ]
        cells = []
        for name in ("accuracy", "class_mean_accuracy"):
            values = 100 * np.array([record["scores"][name] for record in records])
            sem = values.std(ddof=1) / np.sqrt(2)
            cells.append(f"{values.mean():.1f} ± {sem:.1f} (n=2)")
        assert f"| {row} | {cells[0]} | {cells[1]} |" in text
        best = 100 * np.array([record["choices"]["oracle"]["accuracy"] for record in records])
        spread = best.std(ddof=1) / np.sqrt(2)
        assert re.search(rf"\| {row} \|.*\| {best.mean():.1f} ± {spread:.1f} \|\n", text)
    kept = np.mean([record["rounds"][-1]["kept"] for record in records], axis=0)
    over = np.mean([sum(record["rounds"][-1]["confident"]) for record in records])
    rounds = [one for record in records for one in record["rounds"]]
    trained = sum(not one["skipped"] for one in rounds)
    told = [f"{kept.sum():.1f} of {over:.1f}", f"{trained} of {len(rounds)}"]
    cells = [*(f"{value:.1f}" for value in kept), *told]
    assert f"| qbst | {' | '.join(cells)} |" in text


def test_the_csv_has_every_run_and_rule(finished):
    with (finished / "adaptation-bench.csv").open() as handle:
        rows = list(csv.DictReader(handle))
    for name in BOTH:
        record = read_record(finished / "results" / name)
        _, row, _ = name.split("_")
        mine = [r for r in rows if r["row"] == row and r["seed"] == "0"]
        assert {r["rule"] for r in mine} == {"chosen (last)", *record.choices}
        oracle = next(r for r in mine if r["rule"] == "oracle")
        assert float(oracle["accuracy"]) == record.choices["oracle"]["accuracy"]


def test_self_training_starts_from_the_run_of_the_other_row(finished):
    settings = json.loads((finished / "runs/S-D/qbst/seed-0/settings.json").read_text())
    assert settings["warm_up"] is not None
    assert not (finished / "runs/S-D/qbst/seed-0/warm-up").exists()
    assert read_record(finished / "results" / BOTH[0]).method == "qs3"


def test_only_what_is_missing_is_made_again_and_with_the_same_numbers(finished, make, tmp_path):
    folder = copy(finished, tmp_path)
    wanted, bytes_ = scores(finished), weights(finished)
    (folder / "results" / BOTH[0]).unlink()
    shutil.rmtree(folder / "runs/S-D/qbst/seed-0")
    trained = []

    def train(work):
        trained.append(work.run.folder)
        type(make).train(work)

    make.train = train
    make(folder, seeds=(0, 1))
    assert trained == ["S-D/qbst/seed-0"]
    assert scores(folder) == wanted
    assert sorted(weights(folder).values()) == sorted(bytes_.values())
    assert "3 of 4 runs are there already" in make.told[1]
    trained.clear()
    make(folder, seeds=(0, 1))
    assert trained == []


def test_a_stop_between_training_and_record_loses_nothing(finished, make, tmp_path):
    folder = copy(finished, tmp_path)
    shutil.rmtree(folder / "results")
    shutil.rmtree(folder / "runs")

    def stop(work):
        if work.run.row == "qbst":
            raise KeyboardInterrupt
        return type(make).evaluate(work)

    make.evaluate = stop
    with pytest.raises(KeyboardInterrupt):
        make(folder, seeds=(0, 1))
    assert [path.name for path in (folder / "results").iterdir()] == [BOTH[1]]
    make.evaluate = type(make).evaluate
    make(folder, seeds=(0, 1))
    assert scores(folder) == scores(finished)


def spoil(path, **changes):
    value = json.loads(path.read_text())
    for name, new in changes.items():
        value[name] = new
    path.write_text(json.dumps(value))


@pytest.mark.parametrize(
    ("fault", "said"),
    [
        (lambda path: path.write_text("{"), "not a JSON file"),
        (lambda path: spoil(path, seed="0"), "'seed'"),
        (lambda path: spoil(path, seed=7), "seed differs"),
        (lambda path: spoil(path, method="spst"), "method differs"),
        (lambda path: spoil(path, settings={}), "train differs"),
        (lambda path: spoil(path, extra=1), "'extra' is unknown"),
    ],
)
def test_a_foreign_or_damaged_record_is_refused_by_name(finished, make, tmp_path, fault, said):
    folder = copy(finished, tmp_path)
    path = folder / "results" / BOTH[0]
    fault(path)
    with pytest.raises(InputError, match=said) as caught:
        make(folder)
    assert str(path) in str(caught.value)


def test_a_stray_file_among_the_records_is_refused(finished, make, tmp_path):
    folder = copy(finished, tmp_path)
    stray = shutil.copy(folder / "results" / BOTH[0], folder / "results" / "best.json")
    with pytest.raises(InputError, match=re.escape(str(stray))):
        make(folder)


def test_records_of_other_data_do_not_share_a_table(finished):
    results = [
        Result(run, read_record(finished / "results" / run.record))
        for run in make_grid(SCALES["smoke"], ["source-only", "qbst"], ["S-D"], [0])
    ]
    other = dataclasses.replace(results[1].record.test, checksum="0")
    record = dataclasses.replace(results[1].record, test=other)
    with pytest.raises(InputError, match=BOTH[0]):
        group_results([results[0], Result(results[1].run, record)])


def test_another_scale_in_the_same_folder_is_refused(finished, make):
    bench = make.bench(finished, threads=2)
    with pytest.raises(InputError, match="another threads"):
        from qs3.experiments.adaptation_bench import make_bench

        make_bench(bench, make.train, make.evaluate, make.told.append)


def test_the_ablation_shares_data_and_warm_up(finished, make, tmp_path):
    folder = copy(finished, tmp_path)
    rows = ("qbst", "qbst-least-confident")
    path = make(folder, name="adaptation-ablation", tasks=(), rows=rows)
    lines = [line for line in path.read_text().splitlines() if line.startswith("| qbst")]
    assert len(lines) == 3 * 2  # scores, choices, counts
    assert not list(folder.glob("runs/M-D"))
    settings = read_record(folder / "results/S-D_qbst-least-confident_seed-0.json").settings
    assert settings["self_training"]["selection"] == "least-confident"
    make(folder, seeds=(0, 1))  # the ablation's records do not disturb the bench


def test_dry_run_prints_counts_and_hours_and_writes_nothing(
    small_scales, finished, tmp_path, capsys
):
    folder = copy(finished, tmp_path)
    shutil.rmtree(folder / "runs")
    shutil.rmtree(folder / "results")
    before = sorted(folder.rglob("*"))
    options = ReproduceOptions(
        ("adaptation-bench",), folder, "smoke", dry_run=True, methods=("qbst",)
    )
    assert reproduce(options) == 0
    said = capsys.readouterr().out
    # Two tasks, three seeds, and a warm-up each.
    assert re.search(r"30 scans of the source, 48 scans of the target; 12 runs, 12 of", said)
    assert re.search(r"about \d+\.\d\d hours", said)
    assert sorted(folder.rglob("*")) == before


def test_the_paper_s_rows_come_first_and_the_grid_counts():
    assert ROWS[:8] == (
        "supervised", "source-only", "pointdan", "defrec", "defrec-pcm", "gast", "gast-spst", "qbst"
    )  # fmt: skip
    runs = make_grid(SCALES["small"], ROWS, ["M-D", "S-D", "S-R"], [0, 1, 2])
    # The supervised row is one for all sources, and real objects have none.
    assert len(runs) == 3 * (3 * 12 + 1)
    assert len({run.folder for run in runs}) == len(runs)
    made = set()
    for run in runs:
        assert run.warm_up is None or f"{run.task}/{run.warm_up}/seed-{run.seed}" in made
        made.add(run.folder)


def test_small_is_at_the_floor_and_smoke_below():
    assert not SCALES["small"].smoke
    assert SCALES["smoke"].smoke
    few = dataclasses.replace(SCALES["small"], source_per_class=44)
    assert few.smoke  # a tenth is held out: 39.6 are trained on


@pytest.mark.parametrize(
    "arguments",
    [(["qbst", "qbst"], ["S-D"], [0]), (["nobody"], ["S-D"], [0]), (["qbst"], ["S-D"], [])],
)
def test_a_grid_of_nothing_twice_or_unknown_is_refused(arguments):
    with pytest.raises(InputError):
        make_grid(SCALES["smoke"], *arguments)


def test_the_ablation_changes_one_setting_a_row():
    base = make_run(SCALES["small"], "S-D", "qbst", 0).self_training
    for row, changes in ABLATIONS.items():
        run = make_run(SCALES["small"], "S-D", row, 0)
        assert run.self_training == dataclasses.replace(base, **changes)
        assert len(changes) == (row != "qbst")


def test_no_mesh_is_on_both_sides(shared_data, tiny):
    scale = dataclasses.replace(tiny, source_per_class=30, target_per_class=15)
    for folder in (None, shared_data):
        sides = choose_meshes(scale, folder)
        key = [item.path or (item.class_name, item.shape_seed) for item in sides.source]
        other = [item.path or (item.class_name, item.shape_seed) for item in sides.target]
        assert len({*key, *other}) == len(key) + len(other)
        for name in shapes.CLASSES:
            count = sum(item.class_name == name for item in sides.source)
            assert count == 30
        assert (sides.cad > 60) == (folder is not None)
    for item in sides.source + sides.target:
        if item.path is not None:
            assert item.class_name != "bathtub"  # one mesh alone
            side = side_of(item.path.name)
            assert (item in sides.source) == (side == "source")
            assert item.split == ("train" if side == "source" else side)


def test_the_target_has_rooms_frequent_classes(tiny):
    target = choose_meshes(tiny, None).target
    counts = {
        (name, split): sum(i.class_name == name and i.split == split for i in target)
        for name in ("chair", "lamp")
        for split in ("train", "test")
    }
    assert list(counts.values()) == [4, 4, 2, 2]


def test_real_objects_must_be_at_hand(make, tmp_path):
    with pytest.raises(InputError, match="QS3_SHARED_DATA"):
        make(tmp_path / "bench", tasks=("S-R",))
    setup = Setup(tmp_path, TASKS)
    assert all(run.target == "D" for run in Bench("adaptation-bench", setup).runs())


TASKS = dataclasses.replace(SCALES["smoke"], tasks=("S-D", "S-R"))


def test_hours_follow_the_number_of_steps(tiny):
    steps = {"source-only": 1.0, "dann": 3.0}
    scale = dataclasses.replace(tiny, train=dataclasses.replace(tiny.train, epochs=10))
    counts = Counts(source=40, target=64, test=16)  # 36 trained on: 3 batches; 4 of the target
    looks = 10 * (40 + 64 + 16) / 16 / 3
    source_only = make_run(scale, "S-D", "source-only", 0)
    assert run_seconds(source_only, counts, steps) == pytest.approx(30 + looks)
    dann = make_run(scale, "S-D", "dann", 0)
    assert run_seconds(dann, counts, steps) == pytest.approx(10 * 4 * 3 + looks)
    qbst = make_run(scale, "S-D", "qbst", 0)  # two rounds of an epoch, on both domains
    assert run_seconds(qbst, counts, steps) == pytest.approx(2 * 4 * 2 + 4 * 120 / 16 / 3)


def test_a_line_without_a_rule_says_nothing_of_it(finished):
    run = make_run(SCALES["smoke"], "S-D", "qbst", 0)
    record = read_record(finished / "results" / BOTH[0])
    line = Line("S-D", "qbst", (Result(run, dataclasses.replace(record, choices={})),))
    assert line.mean("snd") is None
    assert line.mean().mean == record.scores.accuracy


def test_published_figures_are_of_rows_that_exist():
    for task in ("M-D", "S-D"):
        assert set(published()[task]) <= set(ROWS)
        assert all(0 < value < 100 for pair in published()[task].values() for value in pair)
