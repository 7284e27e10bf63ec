"""Which runs make a table: their fields, their data, and the figures beside them."""

import dataclasses
from pathlib import Path

import numpy as np
import pytest

from qs3 import shapes
from qs3.adaptation import method_class
from qs3.adaptation.names import split_method
from qs3.errors import InputError
from qs3.experiments import TABLES
from qs3.experiments.data import choose_meshes, make_plans, side_of
from qs3.experiments.domains import Domain, data_of, parse_own
from qs3.experiments.experiment import load_experiment, published
from qs3.experiments.grid import data_sets
from qs3.experiments.reproduce import choose_tables, collect_runs
from qs3.experiments.runs import ORDINARY, PAPER, ROWS, SUPERVISED, make_run
from qs3.experiments.scales import SCALES
from qs3.experiments.setup import Setup, count_own
from qs3.experiments.table import Table
from qs3.io import load_clouds, load_unlabelled
from qs3.io.clouds import digests
from qs3.io.preparation import ROBUST
from qs3.training.batches import count_batches
from qs3.training.config import TrainSettings

from .conftest import TINY

S, D, R = Domain("S"), Domain("D"), Domain("R")


@pytest.mark.parametrize("scale", SCALES.values(), ids=SCALES)
def test_every_cell_has_its_data_and_its_work_list(scale, tmp_path):
    runs = collect_runs(choose_tables(TABLES, Setup(tmp_path, scale, seeds=(0,))))
    sets = data_sets(runs)
    assert {data.kind for data in sets} == {
        "source", "held", "target", "fused", "jitter", "second", "views", "sensor"
    }  # fmt: skip
    assert {d.views for d in sets} - {0} == {*scale.fused_views} - {scale.source_views}
    assert {d.sensor for d in sets} - {""} == {*scale.sensors}
    made: set[str] = set()
    for run in runs:
        before = run.warm_up
        assert before is None or before.folder in made
        made.add(run.folder)
    few = dataclasses.replace(scale, source_per_class=1, target_per_class=1, test_per_class=1)
    plans = make_plans(few, choose_meshes(few, None), sets)
    assert len(plans) == len(sets) and all(plan.rows for plan in plans.values())


def test_a_run_is_known_by_its_fields():
    sensors = (Domain("A", sensor="kinect-v1"), Domain("A", sensor="d435"))
    run = make_run(TINY, *sensors, ORDINARY, seed=3)
    assert run.fields == {
        "source": "A", "source_sensor": "kinect-v1", "target": "A", "target_sensor": "d435",
        "row": "ordinary", "seed": 3,
    }  # fmt: skip
    assert [part.data.name for part in run.parts if part] == ["sensor-kinect-v1", "sensor-d435"]
    theta = make_run(TINY, S, D, PAPER, threshold=0.2)
    assert theta.fields["threshold"] == theta.self_training.threshold == 0.2
    # The row's own value is one training with the table of methods.
    assert make_run(TINY, S, D, PAPER, threshold=0.0) == make_run(TINY, S, D, PAPER)
    # Trained on the target's own labels, the supervised row is one for all sources.
    assert make_run(TINY, S, D, SUPERVISED) == make_run(TINY, Domain("M"), D, SUPERVISED)
    with pytest.raises(InputError, match="unknown row"):
        make_run(TINY, S, D, "nobody")


def test_runs_have_the_settings_of_their_row():
    paper = make_run(TINY, S, D, PAPER)
    assert paper.self_training.pool == "shrinking" and paper.self_training.init == "scratch"
    assert paper.warm_up == make_run(TINY, S, D, ORDINARY)
    for name, row in ROWS.items():
        if row.changes:
            base = make_run(TINY, S, D, PAPER if row.preset == "paper" else "qbst").self_training
            # A share of the clouds sets the threshold itself.
            plain = {"threshold": 0.8} if "threshold_share" in row.changes else {}
            changed = dataclasses.replace(base, **plain, **row.changes)
            assert make_run(TINY, S, D, name).self_training == changed != base
    assert make_run(TINY, S, D, "gast-spst").warm_up.row == "gast"


def test_real_objects_must_be_at_hand_and_have_no_supervised_row(tmp_path):
    setup = Setup(tmp_path, TINY, seeds=(0,))
    bench = choose_tables(["uda"], setup)
    assert {run.target for run in collect_runs(bench)} == {D, Domain("F")}
    asked = choose_tables(["uda"], setup, columns=["S-R"])
    with pytest.raises(InputError, match="QS3_SHARED_DATA"):
        collect_runs(asked)
    assert asked[0].cells[SUPERVISED, "S-R"] == []


def test_the_paper_s_cells_have_their_published_figures():
    for name, row, column, figures in (
        ("ordinary", "dgcnn", "S-D", (64.0, 1.0)),
        ("uda", PAPER, "S-D", (72.4, 0.8)),
        ("uda", ORDINARY, "M-D", (46.7, 1.4)),
        ("uda", SUPERVISED, "S-F", (78.7, 0.8)),
        ("uda", SUPERVISED, "S-D", None),
        ("real2sim", "simpleview", "D-M", (69.4, 1.3)),
        ("pointda10", "dann", "F-N", (71.6, None)),
        ("uda", "qbst", "S-D", None),
        ("uda", "gast@dgcnn", "S-D", (61.8, 1.0)),
        ("views", "dgcnn", "1", None),
    ):
        assert load_experiment(name).published_cell(row, column) == figures
    for name in ("ordinary", "real2sim", "pointda10", "uda"):
        experiment, scale = load_experiment(name), SCALES["paper"]
        rows = {experiment.published_as.get(r.key, r.key) for r in experiment.rows(scale)}
        columns = {column.key for column in experiment.columns(scale)}
        for column in columns & set(published()[experiment.published]):
            assert set(published()[experiment.published][column]) <= rows


@pytest.mark.parametrize(
    ("names", "rows", "columns", "seeds", "said"),
    [
        (["ordinary"], ["typo"], [], (0,), "--methods typo; choose one of dgcnn"),
        (["ordinary"], [], ["typo"], (0,), "--tasks typo; choose one of"),
        (["ordinary", "ordinary"], [], [], (0,), "name each once"),
        (["ordinary"], [], [], (0, 0), "name each once"),
        (["ordinary"], [], [], (), "at least one"),
        (["typo"], [], [], (0,), "unknown table"),
        (["ordinary", "views"], ["dgcnn"], ["1"], (0,), "its columns are M-D"),
    ],
)
def test_unknown_names_are_refused(names, rows, columns, seeds, said, tmp_path):
    setup = Setup(tmp_path, TINY, seeds=seeds)
    with pytest.raises(InputError, match=said):
        collect_runs(choose_tables(names, setup, rows, columns))


def test_small_is_at_the_floor_and_smoke_below():
    assert not SCALES["small"].smoke
    assert SCALES["smoke"].smoke
    few = dataclasses.replace(SCALES["small"], source_per_class=44)
    assert few.smoke  # a tenth is held out: 39.6 are trained on


def test_no_mesh_is_on_both_sides(shared_data):
    scale = dataclasses.replace(TINY, source_per_class=30, target_per_class=15)
    for folder in (None, shared_data):
        sides = choose_meshes(scale, folder)
        key = [item.path or (item.class_name, item.shape_seed) for item in sides.source]
        other = [item.path or (item.class_name, item.shape_seed) for item in sides.target]
        assert len({*key, *other}) == len(key) + len(other)
        for name in shapes.CLASSES:
            assert sum(item.class_name == name for item in sides.source) == 30
        assert (sides.cad > 60) == (folder is not None)
    for item in sides.source + sides.target:
        if item.path is not None:
            assert item.class_name != "bathtub"  # one mesh alone
            side = side_of(item.path.name)
            assert (item in sides.source) == (side == "source")
            assert item.split == ("train" if side == "source" else side)


def test_the_target_has_rooms_frequent_classes():
    target = choose_meshes(TINY, None).target
    counts = {
        (name, split): sum(i.class_name == name and i.split == split for i in target)
        for name in ("chair", "lamp")
        for split in ("train", "test")
    }
    assert list(counts.values()) == [4, 4, 2, 2]


@pytest.mark.parametrize(
    ("given", "said"),
    [
        (["D"], "NAME=PATH"),
        (["D=nowhere-at-all"], "does not exist"),
        (["Q=."], "the domains are"),
        (["D=.", "D=."], "each domain once"),
        (["D=.:train"], "does not exist"),
    ],
)
def test_data_of_the_user_that_cannot_be_is_refused(given, said):
    with pytest.raises(InputError, match=said):
        parse_own(given)


def test_a_path_through_a_link_and_a_name_of_ours_are_the_user_s(tmp_path):
    (tmp_path / "target").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "target")
    own = parse_own([f"S={tmp_path / 'link'}"])
    run = make_run(TINY, S, D, ORDINARY, own=own)
    source, _, test = run.parts
    assert source.locate(tmp_path, None) == (tmp_path / "target").resolve()
    assert test.locate(tmp_path, None) == tmp_path / "data" / "target"  # not the user's
    assert [data.name for data in data_sets([run])] == ["target"]
    with pytest.raises(InputError, match="partiality: compares S"):
        choose_tables(["partiality"], Setup(tmp_path, TINY, own=own))
    with pytest.raises(InputError, match="no clouds to score on"):
        make_run(TINY, S, Domain("J"), ORDINARY)
    assert data_of(S, own).stands_for == "" and data_of(D, own).stands_for


def test_laptop_judges():
    scale = SCALES["laptop"]
    assert not scale.smoke and scale.source_per_class >= 60
    sides = choose_meshes(dataclasses.replace(scale, source_per_class=1), None)
    assert sum(item.split == "test" for item in sides.target) >= 400
    # Equal numbers of steps, whatever the source.
    for kind, clouds in (("S", 600), ("S+C+M", 1800), ("D", 1400)):
        train = make_run(scale, Domain(kind), D, ORDINARY).train
        batches = count_batches(clouds - int(0.1 * clouds), train.batch_size)
        assert train.epochs * batches == pytest.approx(4000, rel=0.01)
    assert make_run(scale, S, D, SUPERVISED).train.epochs == train.epochs
    # And whatever the method: one that uses the target goes once through the larger of both.
    for row, kind in ROWS.items():
        uses = method_class(split_method(kind.method)[0]).uses_target
        for target, adapted_to in ((D, 1394), (Domain("F"), 1400), (R, 520), (Domain("U"), 32)):
            if row == SUPERVISED:
                continue
            train = make_run(scale, S, target, row).train
            counts = (540, adapted_to if uses else 0)
            batches = max(count_batches(count, train.batch_size) for count in counts)
            assert train.epochs * batches == pytest.approx(4000, rel=0.02), (row, target)
            assert uses or train.epochs == make_run(scale, S, D, ORDINARY).train.epochs
    plans = make_plans(scale, sides, data_sets([make_run(scale, S, D, ORDINARY)]))
    sensors = {name: plan.settings.as_dict()["sensor"]["name"] for name, plan in plans.items()}
    assert sensors == {"source": "d435", "target": "kinect-v1"}
    assert {plan.settings.real_size for plan in plans.values()} == {"class"}


@pytest.mark.parametrize("name", SCALES)
def test_a_number_of_steps_replaces_that_of_the_scale(name):
    usual = SCALES[name]
    scale = dataclasses.replace(usual, optimiser_steps=1500)
    assert scale.own_steps and not usual.own_steps
    learnt = usual.count_clouds("S")
    for network in ("", "rscnn"):
        train = make_run(scale, S, D, ORDINARY, network=network).train
        batches = count_batches(learnt - int(0.1 * learnt), train.batch_size)
        assert train.epochs * batches == pytest.approx(1500, rel=0.05)
        rounds = make_run(scale, S, D, PAPER, network=network)
        assert rounds.self_training == make_run(usual, S, D, PAPER).self_training
        assert rounds.warm_up.train == train


def test_a_table_with_dgcnn_has_every_method_of_the_paper():
    rows, _ = Table("uda", Setup(Path(), SCALES["full"])).headings
    keys = {row.key: make_run(SCALES["full"], S, D, **row.fields).train for row in rows}
    assert len(published()["methods"]["S-F"]) == 8
    assert {load_experiment("uda").published_as.get(key, key) for key in keys if "@" in key} > {
        *published()["methods"]["S-F"]
    }
    models = {key.partition("@")[2]: train.model for key, train in keys.items()}
    assert models == {"": "pointnet", "dgcnn": "dgcnn", "pointnet-sa": "pointnet-sa"}


def test_tables_of_networks_in_metres_have_a_forest_and_a_cheap_simpleview():
    rows, _ = Table("ordinary", Setup(Path(), SCALES["laptop"])).headings
    runs = [make_run(SCALES["laptop"], S, D, ORDINARY, **row.fields) for row in rows]
    trained = {run.network: run.train for run in runs}
    assert list(trained)[-2:] == ["simpleview-64", "forest"]
    assert trained["simpleview-64"].model == "simpleview"
    assert trained["simpleview-64"].model_settings == {"resolution": 64}
    assert trained["forest"] == TrainSettings(model="forest", preparation=ROBUST)
    assert load_experiment("ordinary").published_cell("simpleview-64", "M-D") == (54.6, 0.7)


def test_the_user_s_own_data_count_by_their_size(whole):
    data, scale = whole / "data", SCALES["laptop"]
    own = parse_own([f"S={data / 'source'}:train:train", f"D={data / 'target'}"])
    own = count_own(own, TINY)
    assert [own[kind].train.count for kind in "SD"] == [30, 24] and own["D"].test.count == 24
    for row, batches in (("ordinary", 1), ("gast", 1), ("gast-spst", 1)):
        run = make_run(scale, S, D, row, own=own)
        assert run.train.epochs == 4000 / batches
        before = run.warm_up
        assert before is None or before.train.epochs == run.train.epochs
    many = {
        "D": dataclasses.replace(own["D"], train=dataclasses.replace(own["D"].train, count=640))
    }
    assert make_run(scale, S, D, "gast", own=many).train.epochs == 200
    assert make_run(scale, S, D, "ordinary", own=many).train.epochs == 235


def test_the_target_of_a_run_can_be_a_part_of_its_clouds(tmp_path):
    full = SCALES["full"]
    runs = collect_runs(choose_tables(["growth"], Setup(tmp_path, full, seeds=(0,))))
    counts = {run.parts[1].count for run in runs if run.parts[1] is not None}
    assert counts == {500, 1500, 3000, None}  # None is all 6,006
    trained = {run.folder for run in runs if run.row == ORDINARY}
    assert len(trained) == 4  # M and S, of two networks: no cloud of the target is seen


def test_rounds_start_from_one_training_of_the_source():
    scale = SCALES["laptop"]
    rows = ("spst", PAPER, "qbst", "qbst-gentle")
    for network in ("", "dgcnn"):
        first = {make_run(scale, S, D, row, network=network).warm_up.folder for row in rows}
        also = make_run(scale, S, R, PAPER, network=network).warm_up.folder
        assert first == {also} == {make_run(scale, S, D, ORDINARY, network=network).folder}
    sized = {row: make_run(scale, S, D, row).train.preparation.size_input for row in ROWS}
    assert {row for row, told in sized.items() if not told} == {
        row for row, kind in ROWS.items() if method_class(split_method(kind.method)[0]).in_unit_ball
    }
    gentle = make_run(SCALES["smoke"], S, D, "qbst-gentle").self_training
    assert gentle.threshold_share == 0.5 and gentle.threshold == 0.8  # the scale's has no say
    rows, _ = Table("uda", Setup(Path(), scale)).headings
    keys = {row.key for row in rows}
    assert {*(f"{row}@dgcnn" for row in ("ordinary", "spst", PAPER, "qbst"))} <= keys
    rows, _ = Table("uda", Setup(Path(), SCALES["small"])).headings
    assert not any("@dgcnn" in row.key for row in rows)  # its network is the paper's already


def test_real_objects_are_adapted_to_in_early_frames_and_scored_in_late_ones(tmp_path):
    rng = np.random.default_rng(0)
    frame, strict = np.repeat(np.arange(10), 3), np.arange(30) % 3 > 0
    np.savez(
        tmp_path / "nyuv2_objects.npz",
        points=rng.normal(size=(30, 40, 3)).astype(np.float16),
        label=np.arange(30) % 2, class_names=np.array(["bed", "chair"]), frame=frame, strict=strict,
    )  # fmt: skip
    run = make_run(SCALES["laptop"], S, R, PAPER)
    _, target, test = run.parts
    files = {part.locate(tmp_path, tmp_path) for part in (target, test)}
    assert files == {tmp_path / "nyuv2_objects.npz"}
    (path,) = files
    whole = load_clouds(path, num_points=None)
    for part, rows in ((target, strict & (frame < 7)), (test, strict & (frame >= 7))):
        clouds = load_clouds(path, split=part.split, num_points=None)
        assert np.array_equal(clouds.points, whole.points[rows])
        assert np.array_equal(clouds.labels, whole.labels[rows])
        assert clouds.origin.split == part.split and clouds.checksum == whole.checksum
    unlabelled = load_unlabelled(path, split=target.split, num_points=None)
    # In an order that tells no label.
    assert set(digests(unlabelled.points)) == set(digests(whole.points[strict & (frame < 7)]))
    with pytest.raises(InputError, match="strict-dev and strict-check"):
        load_clouds(path, split="train")
