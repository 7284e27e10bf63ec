"""Which cells make a table: their fields, their settings and data, and the figures beside them."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from qs3 import shapes
from qs3.adaptation import method_class
from qs3.adaptation.names import split_method
from qs3.clouds.load import load_clouds, load_unlabelled
from qs3.clouds.preparation import ROBUST
from qs3.clouds.types import digests
from qs3.errors import InputError
from qs3.paper import TABLES
from qs3.paper.cells import ORDINARY, PAPER, ROWS, SUPERVISED, Cell, data_sets_of, make_cell
from qs3.paper.domains import find_domain, parse_data
from qs3.paper.experiment import load_experiment, published
from qs3.paper.prepare import choose_meshes, make_plans, side_of
from qs3.paper.reproduce import choose_tables, collect_cells
from qs3.paper.scales import SCALES
from qs3.paper.setup import Setup, count_data
from qs3.paper.table import Table
from qs3.runs.settings import TrainSettings
from qs3.training.loop import count_batches

from .conftest import TINY


def bench(scale=TINY, out=Path("bench"), **changes):
    return Setup(out, SCALES.get(scale, scale) if isinstance(scale, str) else scale, **changes)


def cell_of(row=ORDINARY, source="S", target="D", setup=None, **fields):
    return make_cell(setup or bench(), row=row, source=source, target=target, **fields)


def rounds_of(row, scale=TINY, **fields):
    return cell_of(row, setup=bench(scale), **fields).rounds(bench(scale).scale)


def train_of(row, scale="laptop", source="S", target="D", network="", **changes):
    setup = bench(scale, **changes)
    return cell_of(row, source, target, setup, network=network).training(setup)


@pytest.mark.parametrize("scale", SCALES.values(), ids=SCALES)
def test_every_cell_has_its_data_and_its_work_list(scale, tmp_path):
    setup = bench(scale, tmp_path, seeds=(0,))
    cells = collect_cells(choose_tables(TABLES, setup))
    sets = data_sets_of(cells, setup)
    assert {name for name, *_ in sets} == {
        "source", "held", "target", "fused", "jitter", "views", "sensor"
    }  # fmt: skip
    more = {name: {data[1] for data in sets if data[0] == name} for name in ("views", "sensor")}
    assert more["views"] == {*scale.fused_views} - {scale.source_views}
    assert more["sensor"] == {*scale.sensors}
    for position, cell in enumerate(cells):
        assert cell.warm_up is None or cell.warm_up in cells[:position]
    few = replace(scale, source_per_class=1, target_per_class=1, test_per_class=1)
    plans = make_plans(few, choose_meshes(few, None), sets)
    assert len(plans) == len(sets) and all(plan.rows for plan in plans.values())


@pytest.mark.parametrize(("name", "views"), [("full", 1), ("laptop", 5)])
def test_noise_free_objects_are_those_of_the_target(name, views):
    few = replace(SCALES[name], source_per_class=1, target_per_class=1, test_per_class=1)
    plans = make_plans(few, choose_meshes(few, None), [("target",), ("fused",)])
    target, fused = plans["target",], plans["fused",]
    assert fused.items == target.items
    assert fused.settings == replace(target.settings, views=views)


def test_a_cell_is_known_by_its_fields():
    sensors = {"source_sensor": "kinect-v1", "target_sensor": "d435"}
    cell = cell_of(ORDINARY, "A", "A", seed=3, **sensors)
    assert cell.fields == {
        "source": "A", "source_sensor": "kinect-v1", "target": "A", "target_sensor": "d435",
        "row": "ordinary", "seed": 3,
    }  # fmt: skip
    assert Cell(**cell.fields) == cell
    assert [part.name for part in cell.parts(bench()) if part] == [
        "sensor-kinect-v1", "sensor-d435"
    ]  # fmt: skip
    theta = cell_of(PAPER, threshold=0.2)
    assert theta.fields["threshold"] == theta.rounds(TINY).threshold == 0.2
    step = cell_of(PAPER, step=0.0)
    assert step.fields["step"] == 0.0 and step.rounds(TINY).threshold == 0.0  # the scale's
    # The row's own value is one training with the table of methods.
    assert cell_of(PAPER, threshold=0.0) == cell_of(PAPER)
    # Trained on the target's own labels, the supervised row is one for all sources.
    assert cell_of(SUPERVISED) == cell_of(SUPERVISED, source="M")
    with pytest.raises(InputError, match="no clouds to score on"):
        cell_of(target="J").parts(bench())


def test_cells_have_the_settings_of_their_row():
    paper = rounds_of(PAPER)
    assert paper.pool == "shrinking" and paper.init == "scratch"
    assert cell_of(PAPER).warm_up == cell_of(ORDINARY)
    for name, row in ROWS.items():
        if row.changes:
            base = rounds_of(PAPER if row.preset == "paper" else "qbst")
            # A share of the clouds sets the threshold itself.
            plain = {"threshold": 0.8} if "threshold_share" in row.changes else {}
            assert rounds_of(name) == replace(base, **plain, **row.changes) != base
    assert cell_of("gast-spst").warm_up.row == "gast"
    gentle = rounds_of("qbst-gentle", "smoke")
    assert gentle.threshold_share == 0.5 and gentle.threshold == 0.8  # the scale's has no say
    unsized = {row for row in ROWS if not train_of(row).preparation.size_input}
    assert unsized == {
        row for row, kind in ROWS.items() if method_class(split_method(kind.method)[0]).in_unit_ball
    }


def test_real_objects_must_be_at_hand_and_have_no_supervised_row(tmp_path):
    setup = bench(out=tmp_path, seeds=(0,))
    tables = choose_tables(["uda"], setup)
    assert {cell.target for cell in collect_cells(tables)} == {"D", "F"}
    chosen = choose_tables(["uda"], setup, columns=["S-R"])
    with pytest.raises(InputError, match="QS3_SHARED_DATA"):
        collect_cells(chosen)
    assert chosen[0].cells[SUPERVISED, "S-R"] == []


def test_the_paper_s_cells_have_their_published_figures():
    scale = SCALES["paper"]
    for name, row, column, figures in (
        ("ordinary", "dgcnn", "S-D", (64.0, 1.0)),
        ("ordinary", "simpleview-64", "M-D", (54.6, 0.7)),
        ("uda", PAPER, "S-D", (72.4, 0.8)),
        ("uda", ORDINARY, "M-D", (46.7, 1.4)),
        ("uda", SUPERVISED, "S-F", (78.7, 0.8)),
        ("uda", SUPERVISED, "S-D", None),
        ("real2sim", "simpleview", "D-M", (69.4, 1.3)),
        ("uda", "qbst", "S-D", None),
        ("uda", "gast@dgcnn", "S-D", (61.8, 1.0)),
        ("adaptation-ablation", PAPER, "S-D", (72.4, 0.8)),
        ("views", "dgcnn", "1", None),
    ):
        assert load_experiment(name, scale).published_cell(row, column) == figures
    for name in ("ordinary", "real2sim", "uda"):
        experiment = load_experiment(name, scale)
        figures = published()[experiment.published]
        for column in {column.key for column in experiment.columns} & set(figures):
            assert set(figures[column]) <= {row.key for row in experiment.rows}


@pytest.mark.parametrize(
    ("names", "rows", "columns", "message"),
    [
        (["ordinary"], ["typo"], [], "--methods typo; choose one of dgcnn"),
        (["ordinary"], [], ["typo"], "--tasks typo; choose one of"),
        (["typo"], [], [], "unknown table"),
        (["ordinary", "views"], ["dgcnn"], ["1"], "its columns are M-D"),
    ],
)
def test_unknown_names_are_refused(names, rows, columns, message):
    with pytest.raises(InputError, match=message):
        collect_cells(choose_tables(names, bench(), rows, columns))


def test_no_mesh_is_on_both_sides(shared_data):
    scale = replace(TINY, source_per_class=30, target_per_class=15)
    for folder in (None, shared_data):
        source, target = choose_meshes(scale, folder).values()
        key = [item.path or (item.class_name, item.shape_seed) for item in source]
        other = [item.path or (item.class_name, item.shape_seed) for item in target]
        assert len({*key, *other}) == len(key) + len(other)
        for name in shapes.CLASSES:
            assert sum(item.class_name == name for item in source) == 30
        artists = sum(item.path is not None for item in source + target)
        assert (artists > 60) == (folder is not None)
    chairs = [item.split for item in target if item.class_name == "chair"]
    assert chairs.count("train") == 30 and chairs.count("test") == 4  # frequent in rooms
    for item in source + target:
        if item.path is not None:
            assert item.class_name != "bathtub"  # one mesh alone
            side = side_of(item.path.name)
            assert (item in source) == (side == "source")
            assert item.split == ("train" if side == "source" else side)


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["D"], "NAME=PATH"),
        (["D=nowhere-at-all"], "does not exist"),
        (["Q=."], "the domains are"),
        (["D=.", "D=."], "each domain once"),
        (["D=.:train"], "does not exist"),
    ],
)
def test_data_of_the_user_that_cannot_be_is_refused(words, message):
    with pytest.raises(InputError, match=message):
        parse_data(words)


def test_a_path_through_a_link_and_a_name_of_ours_are_the_user_s(tmp_path):
    (tmp_path / "target").mkdir()
    (tmp_path / "link").symlink_to(tmp_path / "target")
    parsed = parse_data([f"S={tmp_path / 'link'}"])
    setup = bench(out=tmp_path, data=parsed)
    source, _, test = cell_of(setup=setup).parts(setup)
    assert source.locate(tmp_path, None) == (tmp_path / "target").resolve()
    assert test.locate(tmp_path, None) == tmp_path / "data" / "target"  # not the user's
    assert data_sets_of([cell_of(setup=setup)], setup) == [("target",)]
    with pytest.raises(InputError, match="partiality: compares S"):
        choose_tables(["partiality"], setup)
    assert find_domain("S", parsed).stands_for == "" and find_domain("D", parsed).stands_for


@pytest.mark.parametrize("name", SCALES)
def test_a_number_of_steps_replaces_that_of_the_scale(name):
    usual = SCALES[name]
    scale = replace(usual, optimiser_steps=1500)
    assert scale.has_other_steps and not usual.has_other_steps
    learnt = usual.count_clouds("S")
    for network in ("", "rscnn"):
        train = train_of(ORDINARY, scale, network=network)
        batches = count_batches(learnt - int(0.1 * learnt), train.batch_size)
        assert train.epochs * batches == pytest.approx(1500, rel=0.05)
        assert rounds_of(PAPER, scale, network=network) == rounds_of(PAPER, usual)


def test_tables_of_networks_in_metres_have_a_forest_and_a_cheap_simpleview():
    rows, _ = Table("ordinary", bench("laptop")).headings
    trained = {row.key: train_of(ORDINARY, **row.fields) for row in rows}
    assert list(trained)[-2:] == ["simpleview-64", "forest"]
    assert trained["simpleview-64"].model == "simpleview"
    assert trained["simpleview-64"].model_settings == {"resolution": 64}
    assert trained["forest"] == TrainSettings(model="forest", preparation=ROBUST)


def test_the_user_s_own_data_count_by_their_size(whole):
    data = whole / "data"
    parsed = parse_data([f"S={data / 'source'}:train:train", f"D={data / 'target'}"])
    parsed = count_data(parsed, TINY)
    assert [parsed[kind].train.count for kind in "SD"] == [30, 24] and parsed["D"].test.count == 24
    assert {train_of(row, data=parsed).epochs for row in ("ordinary", "gast", "gast-spst")} == {
        4000
    }
    many = {"D": replace(parsed["D"], train=replace(parsed["D"].train, count=640))}
    assert train_of("gast", data=many).epochs == 200
    assert train_of("ordinary", data=many).epochs == 235


def test_the_target_of_a_cell_can_be_a_part_of_its_clouds():
    setup = bench("full", seeds=(0,))
    cells = collect_cells(choose_tables(["growth"], setup))
    counts = {part.count for cell in cells if (part := cell.parts(setup)[1]) is not None}
    assert counts == {500, 1500, None}  # None is all 2,996
    trained = {cell.folder for cell in cells if cell.row == ORDINARY}
    assert len(trained) == 4  # M and S, of two networks: no cloud of the target is seen


@pytest.mark.parametrize("network", ["", "dgcnn"])
def test_rounds_start_from_one_training_of_the_source(network):
    rows = ("spst", PAPER, "qbst", "qbst-gentle")
    first = {cell_of(row, network=network).warm_up.folder for row in rows}
    also = cell_of(PAPER, target="R", network=network).warm_up.folder
    assert first == {also} == {cell_of(ORDINARY, network=network).folder}


def test_real_objects_are_adapted_to_in_early_frames_and_scored_in_late_ones(tmp_path):
    rng = np.random.default_rng(0)
    frame, strict = np.repeat(np.arange(10), 3), np.arange(30) % 3 > 0
    path = tmp_path / "nyuv2_objects.npz"
    np.savez(
        path,
        points=rng.normal(size=(30, 40, 3)).astype(np.float16),
        label=np.arange(30) % 2, class_names=np.array(["bed", "chair"]), frame=frame, strict=strict,
    )  # fmt: skip
    _, target, test = cell_of(PAPER, target="R").parts(bench("laptop"))
    assert {part.locate(tmp_path, tmp_path) for part in (target, test)} == {path}
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
