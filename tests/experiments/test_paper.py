"""The paper's tables: what they are made of, that their numbers are the records', and a stop."""

import csv
import dataclasses
import json
import os
import shutil
import subprocess
import sys
import time
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest
from qs3.experiments.bench_data import make_plans
from qs3.experiments.catalogue import PartName, TableName
from qs3.experiments.paper import EXPERIMENTS, PaperTable
from qs3.experiments.reproduction import collect_runs, reproduce
from qs3.experiments.rows import ORDINARY, PAPER
from scipy import stats

from qs3.cli import reproduce as command
from qs3.cli.table import FigureOptions, TableOptions, figure, table
from qs3.errors import InputError
from qs3.evaluation.metrics import paired_difference
from qs3.evaluation.records import read_record
from qs3.experiments.domains import domain, parse_own
from qs3.experiments.experiment import cell_runs
from qs3.experiments.figures import draw
from qs3.experiments.galleries import Galleries
from qs3.experiments.grid import data_sets, make_run_record, make_work, run_grid
from qs3.experiments.runs import make_run
from qs3.experiments.scales import SCALES
from qs3.experiments.setup import Setup, read_setup
from qs3.report.figure import png_bytes
from qs3.store.executors import Failure

# So small a network may be sure of one class alone, or of none.
pytestmark = [
    pytest.mark.filterwarnings("ignore:all .* confident clouds"),
    pytest.mark.filterwarnings("ignore:.*warm-up.*"),
]


def setup_of(out, tiny, seeds=(0, 1)):
    return Setup(out, tiny, seeds=seeds, threads=1, workers=1)


def parts_of(setup, *names):
    return [PaperTable(EXPERIMENTS[name], setup) for name in names]


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    return tmp_path_factory.mktemp("paper") / "whole"


@pytest.fixture
def finished(whole, make, tiny, small_scales):
    """Two tables made once: of networks, and of QBST as the paper has it."""
    setup = setup_of(whole, tiny)
    parts = parts_of(setup, "ordinary", "thresholds")
    if not whole.exists():
        make.data(whole, data_sets(collect_runs(parts)))
        reproduce(parts, setup, command._train, command._evaluate, lambda line: None)
    return whole


def test_every_name_of_the_command_line_is_a_table():
    assert set(get_args(TableName)) == set(EXPERIMENTS)
    others = {"galleries", "adaptation-bench", "adaptation-ablation"}
    assert set(get_args(PartName)) == set(EXPERIMENTS) | others


@pytest.mark.parametrize("scale", SCALES.values(), ids=SCALES)
def test_every_cell_has_its_data_and_its_work_list(scale, tmp_path):
    setup = Setup(tmp_path, scale, seeds=(0,))
    runs = collect_runs(parts_of(setup, *EXPERIMENTS))
    sets = data_sets(runs)
    plans = make_plans(scale, None, renderer="none", sets=[]) | dict.fromkeys(sets)
    for run in runs:
        work = make_work(run, tmp_path, None)
        assert work.source.name in plans and work.test.name in plans
        assert work.target is None or work.target.name in plans
    assert {"source", "held", "target", "fused", "jitter", "second"} <= set(sets)
    assert {f"views-{n}" for n in scale.fused_views if n != scale.source_views} <= set(sets)


def test_the_paper_s_cells_have_their_published_figures():
    scale = SCALES["smoke"]
    told = {name: EXPERIMENTS[name].published for name in ("ordinary", "uda", "real2sim")}
    assert told["ordinary"]["dgcnn", "S-D"] == (64.0, 1.0)
    assert told["uda"][PAPER, "S-D"] == (72.4, 0.8)
    assert told["uda"][ORDINARY, "M-D"] == (46.7, 1.4)
    assert told["uda"]["supervised", "S-F"] == (78.7, 0.8)
    assert told["real2sim"]["simpleview", "D-M"] == (69.4, 1.3)
    assert len(told["ordinary"]) == 16 and len(told["real2sim"]) == 8
    cells = cell_runs(EXPERIMENTS["uda"], scale, [0])
    assert set(told["uda"]) <= set(cells)
    run = cells[PAPER, "S-D"][0]
    assert run.self_training is not None and run.self_training.pool == "shrinking"
    assert run.self_training.init == "scratch" and run.warm_up == ORDINARY


def test_numbers_are_those_of_the_records(finished):
    text = (finished / "ordinary.md").read_text()
    assert text.startswith("# *smoke* — Networks without adaptation")
    assert "**Stand-ins, made here**" in text and "ScanNet10 (S*)" in text
    for network, title in (("pointnet2", "PointNet++"), ("dgcnn", "DGCNN")):
        line = [title]
        for task, paper in zip(
            ("M-D", "S-D", "M-F", "S-F"),
            {
                "pointnet2": ("48.4 ± 1.3", "60.9 ± 0.8", "46.1 ± 2.0", "57.9 ± 0.8"),
                "dgcnn": ("46.7 ± 1.4", "64.0 ± 1.0", "48.7 ± 1.0", "51.1 ± 1.2"),
            }[network],
            strict=True,
        ):
            name = f"{task}_ordinary@{network}_seed-{{}}.json"
            records = [read_record(finished / "results" / name.format(seed)) for seed in (0, 1)]
            values = np.array([record.scores.accuracy for record in records])
            sem = values.std(ddof=1) / np.sqrt(2)
            line += [f"{100 * values.mean():.1f} ± {100 * sem:.1f} (n=2)", paper]
        assert f"| {' | '.join(line)} |" in text
    with (finished / "ordinary.csv").open() as handle:
        rows = list(csv.DictReader(handle))
    assert len(rows) == 2 * 4 * 2
    for row in rows:
        name = f"{row['column']}_ordinary@{row['row']}_seed-{row['seed']}.json"
        assert float(row["accuracy"]) == read_record(finished / "results" / name).scores.accuracy
    assert (finished / "ordinary.tex").read_text().count(r"\\") == 3
    assert (finished / "thresholds.png").read_bytes()[1:4] == b"PNG"


def test_one_training_of_a_source_serves_all_targets(finished):
    assert {path.name for path in (finished / "runs" / "S").iterdir()} == {
        "ordinary@pointnet2", "ordinary@dgcnn", "ordinary"
    }  # fmt: skip
    records = [
        read_record(finished / "results" / f"{task}_ordinary@dgcnn_seed-0.json")
        for task in ("S-D", "S-F")
    ]
    assert records[0].source == records[1].source and records[0].target is None
    assert [record.test.cloud for record in records] == ["points", "clean"]
    assert records[0].seconds == records[1].seconds


def test_rows_of_thresholds_are_the_paper_s_qbst(finished):
    settings = json.loads((finished / "runs/S-D/qbst-theta-0.2/seed-0/settings.json").read_text())
    assert settings["self_training"]["threshold"] == 0.2
    assert settings["self_training"]["source_loss"] is False
    other = json.loads((finished / "runs/M-D/qbst-step-0.1/seed-0/settings.json").read_text())
    assert other["self_training"]["step"] == 0.1
    assert other["self_training"]["threshold"] == 0.0  # the scale's


def test_differences_are_paired_over_seeds(finished, tiny):
    part = PaperTable(EXPERIMENTS["ordinary"], setup_of(finished, tiny))
    grid, faults = part.grid()
    assert faults == []
    what, difference = grid.differences()[0]
    assert what == "S over M on D, PointNet++"
    first = grid.cells["pointnet2", "S-D"].accuracies
    second = grid.cells["pointnet2", "M-D"].accuracies
    assert difference.mean == pytest.approx(np.mean([first[s] - second[s] for s in (0, 1)]))
    assert f"- {what}: {difference.format()}" in (finished / "ordinary.md").read_text()


def test_paired_interval_is_the_t_test_s():
    rng = np.random.default_rng(0)
    first, second = rng.random(5), rng.random(5)
    found = paired_difference(dict(enumerate(first)), dict(enumerate(second)) | {9: 1.0})
    wanted = stats.ttest_rel(first, second).confidence_interval(0.95)
    assert found is not None and found.n == 5 and found.interval is not None
    assert found.mean == pytest.approx((first - second).mean())
    assert found.interval == pytest.approx((wanted.low, wanted.high))
    assert paired_difference({0: 1.0}, {1: 1.0}) is None
    one = paired_difference({0: 0.5}, {0: 0.25})
    assert one is not None and one.interval is None and one.mean == 0.25


def test_a_table_without_runs_shows_the_command(finished, capsys, tmp_path):
    folder = shutil.copytree(finished, tmp_path / "copy")
    for path in (folder / "results").glob("S-F_ordinary@dgcnn_*"):
        path.unlink()
    assert table(TableOptions("ordinary", folder)) == 0
    said = capsys.readouterr().out
    assert "1 cells wait for runs" in said
    assert "    qs3 reproduce ordinary --out copy --scale smoke --seeds 0 1\n" in said
    assert next(line for line in said.splitlines() if line.startswith("| DGCNN")).count("…") == 1


def test_a_damaged_or_foreign_record_is_refused_and_the_rest_tabulated(finished, capsys, tmp_path):
    folder = shutil.copytree(finished, tmp_path / "copy")
    results = folder / "results"
    (results / "S-D_ordinary@dgcnn_seed-0.json").write_text("{")
    shutil.copy(
        results / "S-D_ordinary@pointnet2_seed-0.json",
        results / "M-D_ordinary@pointnet2_seed-0.json",
    )
    other = results / "M-F_ordinary@pointnet2_seed-1.json"
    value = json.loads(other.read_text())
    value["test"]["checksum"] = "0"
    other.write_text(json.dumps(value))
    for name, fault in (
        ("S-F_ordinary@dgcnn_seed-1", ("scores", "accuracy", 7.0)),
        ("S-F_ordinary@dgcnn_seed-0", ("test", "split", "train")),
        ("S-D_ordinary@dgcnn_seed-1", ("source", "cloud", "clean")),
    ):
        path = results / f"{name}.json"
        value = json.loads(path.read_text())
        value[fault[0]][fault[1]] = fault[2]
        path.write_text(json.dumps(value))
    assert table(TableOptions("ordinary", folder)) == 1
    out, err = capsys.readouterr()
    refused = [line for line in err.splitlines() if "refused" in line]
    names = ("S-D_ordinary@dgcnn_seed-0", "M-D_ordinary@pointnet2_seed-0", other.stem,
             "S-F_ordinary@dgcnn_seed-1", "S-F_ordinary@dgcnn_seed-0",
             "S-D_ordinary@dgcnn_seed-1")  # fmt: skip
    assert len(refused) == 6
    for name in names:
        assert sum(name in line for line in refused) == 1
    assert "(n=1)" in out and "(n=2)" in out
    with pytest.raises(InputError, match="M-D_ordinary@pointnet2_seed-0"):
        reproduce(
            parts_of(read_setup(folder), "ordinary"), read_setup(folder),
            command._train, command._evaluate, lambda line: None,
        )  # fmt: skip


def test_what_is_missing_is_made_again_with_the_same_numbers(finished, tiny, tmp_path):
    folder = shutil.copytree(finished, tmp_path / "copy")
    lost = "S-F_ordinary@dgcnn_seed-1.json"
    before = (folder / "results" / lost).read_bytes()
    (folder / "results" / lost).unlink()
    texts = {path.name: path.read_bytes() for path in folder.glob("*.*") if path.suffix != ".json"}
    seen = []

    def train(work):
        seen.append(work.run.record)
        command._train(work)

    setup = setup_of(folder, tiny)
    reproduce(
        parts_of(setup, "ordinary", "thresholds"), setup, train, command._evaluate, seen.append
    )
    assert [one for one in seen if one.endswith(".json")] == [lost]
    assert (folder / "results" / lost).read_bytes() == before
    assert {name: (folder / name).read_bytes() for name in texts} == texts


@pytest.mark.slow
def test_several_at_once_give_the_same_numbers(finished, tiny, tmp_path):
    folder = shutil.copytree(finished, tmp_path / "copy")
    shutil.rmtree(folder / "runs")
    shutil.rmtree(folder / "results")
    setup = dataclasses.replace(setup_of(folder, tiny, seeds=(0,)), workers=2)
    parts = parts_of(setup, "ordinary", "thresholds")
    reproduce(parts, setup, command._train, command._evaluate, lambda line: None)
    for path in (folder / "results").iterdir():
        old, new = read_record(finished / "results" / path.name), read_record(path)
        assert (old.scores, old.choices) == (new.scores, new.choices)


class Inline:
    """An executor that ends calls in the order in which it was told."""

    def __init__(self, fail=""):
        self.calls, self.order, self.fail = [], [], fail
        self.most = 0

    @property
    def ahead(self):
        return 9

    def submit(self, key, function, *arguments):
        self.calls.append((key, function, arguments))
        self.most = max(self.most, len(self.calls))

    def next(self):
        key, function, arguments = self.calls.pop()  # the last first
        self.order.append(key)
        if self.fail and self.fail in key:
            return key, Failure("ProcessDied", "no memory left")
        return key, function(*arguments)

    def drain(self):
        return []

    def __enter__(self):
        return self

    def __exit__(self, *exception):
        return None


def works_of(finished, tiny):
    runs = [
        make_run(tiny, "S-D", ORDINARY, 0, 1),
        make_run(tiny, "S-F", ORDINARY, 0, 1),
        make_run(tiny, "S-D", PAPER, 0, 1),
        make_run(tiny, "S-D", ORDINARY, 0, 1, network="dgcnn"),
    ]
    return [make_work(run, finished, None) for run in runs]


def test_a_warm_up_is_waited_for_and_a_folder_has_one_run_at_a_time(finished, tiny, tmp_path):
    works = works_of(finished, tiny)
    record = read_record(finished / "results" / "S-D_ordinary_seed-0.json")
    executor, running = Inline(), []
    run_grid(
        works, tmp_path, running.append, lambda work: record, lambda line: None,
        dict.fromkeys([work.run.record for work in works], 1.0), executor, at_once=3,
    )  # fmt: skip
    order = [key.partition("|")[2] for key in executor.order]
    assert sorted(order) == sorted(work.run.record for work in works)
    assert executor.most == 2  # the source's training, and the other network's
    assert order.index("S-D_ordinary_seed-0.json") < order.index("S-F_ordinary_seed-0.json")
    assert order.index("S-F_ordinary_seed-0.json") < order.index("S-D_qbst-paper_seed-0.json")


def test_a_failed_run_is_named_and_what_others_made_stays(finished, tiny, tmp_path):
    works = works_of(finished, tiny)
    record = read_record(finished / "results" / "S-D_ordinary_seed-0.json")
    failed = run_grid(
        works, tmp_path, lambda work: None, lambda work: record, lambda line: None,
        dict.fromkeys([work.run.record for work in works], 1.0),
        Inline(fail="S-D_ordinary_seed-0"), at_once=2,
    )  # fmt: skip
    assert failed[0] == "S/ordinary/seed-0: ProcessDied: no memory left"
    # What shares its folder and what starts from it cannot be made either.
    assert [line.partition(":")[0] for line in failed[1:]] == [
        "S/ordinary/seed-0", "S-D/qbst-paper/seed-0"
    ]  # fmt: skip
    kept = [path.name for path in (tmp_path / "results").iterdir()]
    assert kept == ["S-D_ordinary@dgcnn_seed-0.json"]


def test_each_device_has_one_run_at_a_time(finished, tiny, tmp_path, monkeypatch):
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", "7,8,3")
    monkeypatch.setattr("torch.cuda.is_available", lambda: True)
    record = read_record(finished / "results" / "S-D_ordinary_seed-0.json")
    works, executor = works_of(finished, tiny), Inline()
    seen = []

    def train(work):
        seen.append(os.environ["CUDA_VISIBLE_DEVICES"])
        os.environ["CUDA_VISIBLE_DEVICES"] = "7,8,3"  # a new process has the scheduler's

    run_grid(
        works, tmp_path, train,
        lambda work: record, lambda line: None,
        dict.fromkeys([work.run.record for work in works], 1.0), executor, devices=("2", "0"),
    )  # fmt: skip
    assert set(seen) == {"3", "7"} and executor.most == 2


def test_a_device_that_is_not_there_is_told(finished, tiny):
    with pytest.raises(InputError, match="--devices 4: no such GPU"):
        make_run_record(lambda work: None, read_record, works_of(finished, tiny)[0], "4")


def test_figures_are_the_same_bytes_each_time(finished, tiny, tmp_path, capsys):
    names = ("ordinary", "thresholds")
    for name in names:
        grid, _ = PaperTable(EXPERIMENTS[name], setup_of(finished, tiny)).grid()
        assert png_bytes(draw(grid)) == (finished / f"{name}.png").read_bytes()
        path = tmp_path / f"{name}.svg"
        assert figure(FigureOptions(name, finished, path)) == 0
        assert "S → D" in path.read_text()
    assert capsys.readouterr().out.split() == [str(tmp_path / f"{name}.svg") for name in names]


def test_galleries_show_procedural_shapes_alone(finished, tiny):
    part = Galleries(setup_of(finished, tiny))
    folder = part.write()
    assert part.sets() == ["source", "source", "target", "fused"]
    assert sorted(path.name for path in folder.iterdir()) == ["D.png", "F.png", "M.png", "S.png"]


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (["D"], "NAME=PATH"),
        (["D=nowhere-at-all"], "not there"),
        (["Q=."], "the domains are"),
        (["D=.", "D=."], "each domain once"),
        (["D=.:train"], "not there"),
        (["=."], "the domains are"),
    ],
)
def test_data_of_the_user_that_cannot_be_is_refused(given, said):
    with pytest.raises(InputError, match=said):
        parse_own(given)


def test_data_of_the_user_takes_a_domain_s_place(finished, tiny, tmp_path):
    data = finished / "data"
    own = parse_own([f"D={data / 'target'}", f"M={data / 'source'}:train:"])
    assert own["D"].stands_for == "" and own["M"].cloud == "surface"
    run = make_run(tiny, "M-D", ORDINARY, 0, 1)
    assert data_sets([run], own) == []
    work = make_work(run, tmp_path, None, own)
    assert work.test == finished / "data" / "target" and work.test_split == "test"
    assert work.source == finished / "data" / "source" and work.source_cloud == "surface"
    setup = dataclasses.replace(setup_of(tmp_path / "own", tiny, seeds=(0,)), own=own)
    part = PaperTable(EXPERIMENTS["ordinary"], setup, ("dgcnn",), ("M-D",))
    reproduce([part], setup, command._train, command._evaluate, lambda line: None)
    text = (tmp_path / "own" / "ordinary.md").read_text()
    assert "D: target" in text and "Stand-ins" not in text
    for changed, said in (
        (f"D={data / 'target'}:train:train", "another data"),
        (f"D={data / 'source'}:train:train", "another data"),
        (f"D={data / 'source'}", "no cloud of split 'test'"),
    ):
        other = dataclasses.replace(setup, own=own | parse_own([changed]))
        with pytest.raises(InputError, match=said):
            reproduce([part], other, command._train, command._evaluate, lambda line: None)
    again = read_setup(tmp_path / "own")
    assert again.own["D"].cloud == "points" and again.seeds == (0,)
    grid, faults = PaperTable(EXPERIMENTS["ordinary"], again, ("dgcnn",), ("M-D",)).grid()
    assert faults == [] and grid.empty == []


def test_a_path_through_a_link_and_a_name_of_ours_are_the_user_s(finished, tiny, tmp_path):
    (tmp_path / "link").symlink_to(finished / "data" / "target")
    own = parse_own([f"S={tmp_path / 'link'}"])
    assert own["S"].train == str((finished / "data" / "target").resolve())
    work = make_work(make_run(tiny, "S-D", ORDINARY, 0, 1), tmp_path, None, own)
    assert work.source == finished / "data" / "target"
    assert work.test == tmp_path / "data" / "target"  # not the user's, for all its name
    assert data_sets([work.run], own) == ["target"]
    with pytest.raises(InputError, match="partiality: compares S"):
        PaperTable(
            EXPERIMENTS["partiality"], dataclasses.replace(setup_of(tmp_path, tiny), own=own)
        ).runs()


def test_caveats_of_a_run_stand_below_the_table(finished, tiny, tmp_path):
    folder = shutil.copytree(finished, tmp_path / "copy")
    path = folder / "results" / "S-D_ordinary@dgcnn_seed-0.json"
    value = json.loads(path.read_text())
    value["marks"] = ["training clouds"]
    path.write_text(json.dumps(value))
    part = PaperTable(EXPERIMENTS["ordinary"], setup_of(folder, tiny))
    grid, _ = part.grid()
    assert "- training clouds: DGCNN on S → D" in part.text(grid, "md")
    assert "% training clouds: DGCNN on S → D" in part.text(grid, "tex")
    assert part.text(grid, "csv").count("training clouds") == 2


def test_rounds_that_did_not_train_and_settings_of_the_scale_are_told(finished, tiny, tmp_path):
    folder = shutil.copytree(finished, tmp_path / "copy")
    part = PaperTable(EXPERIMENTS["thresholds"], setup_of(folder, tiny))
    (place, runs) = next(iter(part.cells().items()))
    for run in runs:
        value = json.loads((folder / "results" / run.record).read_text())
        for number, one in enumerate(value["rounds"]):
            one["skipped"] = number == 1 and run.seed == 0
        (folder / "results" / run.record).write_text(json.dumps(value))
    grid, faults = part.grid()
    assert faults == []
    told = "1 of 4 rounds skipped, confident clouds too few"
    assert grid.cells[place].marks[-1] == told
    text = part.text(grid, "md")
    assert f"- {told}: {dict(grid.rows)[place[0]]} on {dict(grid.columns)[place[1]]}" in text
    assert "Self-training here: threshold 0.0, rounds 2, epochs 1 (paper: 0.8, 10, 10)." in text


@pytest.mark.parametrize(
    ("name", "kind", "wanted"),
    [
        ("a.jpg", None, r"\.png or \.svg"),
        ("a", None, r"\.png or \.svg"),
        ("a.png", "svg", r"\.svg"),
    ],
)
def test_a_figure_s_file_says_its_format(finished, tmp_path, name, kind, wanted):
    with pytest.raises(InputError, match=rf"--out {tmp_path / name}: must end in {wanted}$"):
        figure(FigureOptions("ordinary", finished, tmp_path / name, kind))
    assert not (tmp_path / name).exists()


@pytest.mark.parametrize("option", ["methods", "tasks"])
def test_a_line_or_column_that_no_table_has_is_refused(option, tmp_path):
    told: dict[str, Any] = {option: ("typo",)}
    with pytest.raises(InputError, match=f"--{option} typo: choose from"):
        command.reproduce(command.ReproduceOptions(("ordinary",), tmp_path, "smoke", **told))


@pytest.mark.parametrize(
    "spoil",
    [
        {"data": []},
        {"data": {"D": ["a", "points"]}},
        {"threads": "a"},
        {"scale": {"name": "none"}},
        {"more": 1},
    ],
)
def test_a_damaged_marker_is_told(finished, tmp_path, spoil):
    value = json.loads((finished / "bench.json").read_text())
    (tmp_path / "bench.json").write_text(json.dumps(value | spoil))
    with pytest.raises(InputError, match=r"bench\.json"):
        read_setup(tmp_path)


def test_the_text_tells_how_the_table_s_own_networks_were_trained(tmp_path):
    part = PaperTable(EXPERIMENTS["ordinary"], Setup(tmp_path, SCALES["paper"], seeds=(0,)))
    text = part.text(part.grid()[0], "md")
    assert "1000 epochs, batches of 32, schedule plateau" in text
    assert "418 objects a class of M and S" in text


def test_domains_that_are_not_there_are_told(tiny, tmp_path):
    with pytest.raises(InputError, match="unknown domain"):
        domain("X")
    with pytest.raises(InputError, match="no clouds to score on"):
        make_work(make_run(tiny, "S-J", ORDINARY, 0), tmp_path, None)
    with pytest.raises(InputError, match="its lines are"):
        PaperTable(EXPERIMENTS["views"], setup_of(tmp_path, tiny), ("vgg",)).runs()
    with pytest.raises(InputError, match=r"bench\.json"):
        read_setup(tmp_path)


@pytest.mark.slow
def test_a_ray_cluster_gives_the_same_numbers(finished, tiny, tmp_path):
    pytest.importorskip("ray")
    folder = shutil.copytree(finished, tmp_path / "copy")
    lost = ["M-D_ordinary@dgcnn_seed-0.json", "M-F_ordinary@dgcnn_seed-0.json"]
    shutil.rmtree(folder / "runs" / "M")
    wanted = {name: read_record(folder / "results" / name) for name in lost}
    for name in lost:
        (folder / "results" / name).unlink()
    setup = dataclasses.replace(
        setup_of(folder, tiny, seeds=(0,)), executor="ray", address="local", workers=2
    )
    reproduce(
        parts_of(setup, "ordinary"), setup, command._train, command._evaluate, lambda line: None
    )
    for name, record in wanted.items():
        assert read_record(folder / "results" / name).scores == record.scores


_KILLED = """
import runpy, sys
from pathlib import Path
tiny = runpy.run_path({conftest!r})["TINY"]
from qs3.cli import reproduce as command
from qs3.experiments.paper import EXPERIMENTS, PaperTable
from qs3.experiments.reproduction import reproduce
from qs3.experiments.setup import Setup
setup = Setup(Path(sys.argv[1]), tiny, seeds=(0,), threads=1, workers=1)
parts = [PaperTable(EXPERIMENTS[name], setup) for name in ("ordinary", "thresholds")]
reproduce(parts, setup, command._train, command._evaluate, print)
"""


@pytest.mark.slow
def test_killed_at_any_time_it_goes_on_with_the_same_numbers(finished, tmp_path):
    folder = shutil.copytree(finished, tmp_path / "copy")
    for name in ("runs", "results"):
        shutil.rmtree(folder / name)
    wanted = {path.name: read_record(path) for path in (finished / "results").glob("*seed-0.json")}
    script = _KILLED.format(conftest=str(Path(__file__).parent / "conftest.py"))
    kept: set[str] = set()
    for count in (1, 4, 9, len(wanted)):
        with subprocess.Popen([sys.executable, "-c", script, str(folder)]) as running:
            while running.poll() is None and len(list(folder.glob("results/*.json"))) < count:
                time.sleep(0.01)
            if count < len(wanted):
                running.kill()
        found = {path.name: path.read_bytes() for path in folder.glob("results/*.json")}
        assert kept <= set(found)
        kept = set(found)
    assert running.returncode == 0
    for name, record in wanted.items():
        again = read_record(folder / "results" / name)
        assert (again.scores, again.choices, again.rounds) == (
            record.scores,
            record.choices,
            tuple({**one, "seconds": two["seconds"]} for one, two in zip(
                record.rounds, again.rounds, strict=True)),
        )  # fmt: skip
    assert (folder / "ordinary.md").is_file()
