"""Heights above the floor: kept with the clouds, measured, and joined to answers by Bayes' rule."""

import dataclasses
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import trimesh
from scipy.special import logsumexp

from qs3.errors import InputError
from qs3.io import load_clouds, load_unlabelled
from qs3.io.clouds import PointClouds, RaggedClouds
from qs3.io.extract.plane import find_floor
from qs3.io.layouts.npz import read_npz, write_npz
from qs3.io.layouts.store import read_ragged, write_store
from qs3.io.preparation import ROBUST, Preparation
from qs3.meshes.sizes import SUPPORTS, draw_support
from qs3.store.scan_item import RECIPES, GenerateSettings, _floor
from qs3.training import Classifier, TrainSettings, evaluate, fit
from qs3.training.answers import predict_files
from qs3.training.forest import train_forest
from qs3.training.heights import Heights, measure_heights
from qs3.training.loaded import read_measured
from qs3.training.trained import load_trained

from .common import TRAIN

NAMES = ("low", "high")


def twins(count=24, seed=0) -> PointClouds:
    """Equal boxes of two classes: the one stands on the floor, the other a metre above it."""
    rng = np.random.default_rng(seed)
    points = rng.uniform(size=(count, 80, 3)).astype(np.float32) * np.float32(0.3)
    labels = np.arange(count) % 2
    ids = tuple(f"{seed}-{i}" for i in range(count))
    return PointClouds(points, labels, NAMES, ids, floor=-1.0 * labels)


def trained(model, folder, clouds=None):
    clouds = twins() if clouds is None else clouds
    if model == "forest":
        how = dataclasses.replace(ROBUST, height_input=True)
        settings = TrainSettings(model="forest", preparation=how)
        train_forest("source-only", clouds, None, settings, run_dir=folder)
    else:
        how = TrainSettings(model="pointnet", **TRAIN, preparation=Preparation(height_input=True))
        fit("source-only", clouds, None, how, run_dir=folder)
    return Classifier.load(folder)


@pytest.mark.parametrize("model", ["pointnet", "forest"])
def test_classes_that_differ_in_height_alone_are_told_apart_if_it_is_known(model, tmp_path):
    made, new = trained(model, tmp_path / "run"), twins(16, 1)
    assert (made.predict(new) == np.array(NAMES)[new.labels]).all()
    assert evaluate(tmp_path / "run", new).scores.accuracy == 1
    assert (made.predict(new.points, floor=new.floor) == made.predict(new)).all()
    bare = dataclasses.replace(new, floor=None)
    nowhere = dataclasses.replace(new, floor=np.full(16, np.nan))
    assert evaluate(tmp_path / "run", bare).scores.accuracy < 0.9
    assert np.array_equal(made.predict_proba(bare), made.predict_proba(nowhere))
    other = Classifier.load(made.save(tmp_path / "copy"))
    assert np.array_equal(other.predict_proba(new), made.predict_proba(new))


def test_answers_follow_bayes_rule_and_stay_to_the_bit_without_a_floor(tmp_path):
    trained("forest", tmp_path / "run")
    loaded, new = load_trained(tmp_path / "run"), twins(8, 2)
    floor = np.where(np.arange(8) < 4, new.floor, np.nan)
    before, after = loaded.ask(new.points), loaded.ask(new.points, floor)
    for name in before._fields:
        assert np.array_equal(getattr(after, name)[4:], getattr(before, name)[4:])
    weighed = before.probabilities * np.exp(loaded.heights.odds(new.points, floor))
    wanted = weighed / weighed.sum(axis=1, keepdims=True)
    np.testing.assert_allclose(after.probabilities, wanted, rtol=1e-6)  # leaves have 32 bit
    # What is unknown does not depend on the height.
    energies = [logsumexp(said.logits, axis=1) for said in (before, after)]
    np.testing.assert_allclose(*energies, atol=1e-9)


def test_heights_are_densities_and_need_a_floor():
    clouds = twins(200)
    table = np.exp(measure_heights(clouds).log_odds)
    np.testing.assert_allclose(table.mean(axis=0), 1, atol=1e-3)
    assert table[0, 10] > 1.8  # at the floor
    assert table[1, 30] > 1.8  # a metre above it
    assert abs(table[:, -1] - 1).max() < 0.1  # never seen there
    assert measure_heights(dataclasses.replace(clouds, floor=None)) is None
    with pytest.raises(InputError, match="do not fit its 3 classes"):
        read_measured({"heights": {"log_odds": [[0.0]]}}, 3, Path("a"))
    assert isinstance(measure_heights(clouds), Heights)


def test_floors_stay_with_their_clouds_in_every_layout(tmp_path):
    clouds = twins(7)
    floor = np.where(clouds.labels == 0, np.nan, clouds.floor)
    given = RaggedClouds([*clouds.points], clouds.ids, "", clouds.labels, NAMES, floor=floor)
    write_npz(tmp_path / "a.npz", given)
    write_store(tmp_path / "store", read_npz(tmp_path / "a.npz"))
    back = read_ragged(tmp_path / "store")
    np.testing.assert_array_equal(back.floor, floor)
    assert np.isnan(load_clouds(tmp_path / "store").select(clouds.labels == 0).floor).all()
    target = load_unlabelled(tmp_path / "store", num_points=None)  # in another order
    rows = [np.flatnonzero((clouds.points == one).all(axis=(1, 2)))[0] for one in target.points]
    np.testing.assert_array_equal(target.floor, floor[rows])
    # The shared archives have a centre above the floor in its place.
    np.savez(tmp_path / "b.npz", points=clouds.points, centre=np.full((7, 3), 0.6),
             floor_ok=np.arange(7) > 0)  # fmt: skip
    np.testing.assert_array_equal(read_npz(tmp_path / "b.npz").floor, [np.nan] + 6 * [-0.6])
    with pytest.raises(InputError, match="must be numbers with a point"):
        np.savez(tmp_path / "c.npz", points=clouds.points, floor=np.arange(7))
        read_npz(tmp_path / "c.npz")


def test_predict_looks_at_recorded_and_given_floors(tmp_path):
    trained("forest", tmp_path / "run")
    new = twins(4, 3)
    for row, points in enumerate(new.points):
        np.save(tmp_path / f"{row}.npy", points)
    files = [tmp_path / f"{row}.npy" for row in range(4)]
    (tmp_path / "objects.csv").write_text("file,floor\n0.npy,-1.0\n1.npy,0.0\n2.npy,\n")

    def said(floor=None):
        answers = predict_files(tmp_path / "run", files, floor=floor)
        return [one.probabilities["high"] for one in answers]

    without, given = said(), said(-1.0)
    assert [share > 0.5 for share in given] == [True, False, True, True]
    assert without[:2] == given[:2]  # a floor of its own wins
    assert without[2] < given[2]
    assert without[3] < given[3]


def test_the_lowest_level_plane_is_the_floor(rng):
    flat = np.c_[rng.uniform(-2, 2, (4000, 2)), np.full(4000, -1.2)]
    table = np.c_[rng.uniform(-0.5, 0.5, (9000, 2)), np.full(9000, -0.5)]
    wall = np.c_[rng.uniform(-2, 2, 9000), np.full(9000, 2.0), rng.uniform(-1.2, 1, 9000)]
    room = np.concatenate([flat, table, wall]) + rng.normal(scale=0.01, size=(22_000, 3))
    assert find_floor(room) == pytest.approx(-1.2, abs=0.01)
    assert np.isnan(find_floor(room[13_000:]))  # a wall alone
    assert np.isnan(find_floor(room[4000:13_000], below=-0.8))
    assert np.isnan(find_floor(room[:0]))


def test_generate_knows_the_floor_of_rooms_and_of_tables():
    box = trimesh.creation.box((0.3, 0.3, 0.4))
    rooms, plain = RECIPES["rooms"], GenerateSettings(sensor="d435", object_size=0.4)
    result = SimpleNamespace(mesh=box, sensor=SimpleNamespace(metric=True), drawn={})

    def floor(layout, settings, class_name="bed", seed=0, **drawn):
        result.drawn = {f"room.{name}": value for name, value in drawn.items()}
        return _floor(result, layout, settings, class_name, seed)

    assert floor("alone", plain) is None
    assert floor("floor", plain) == floor("alone", rooms) == pytest.approx(-0.2)
    assert floor("floor+table", plain) == pytest.approx(-0.95)
    assert floor("room+table", rooms, "monitor", table=0.7) == pytest.approx(-0.9)
    drawn = [-0.2 - floor("wall", rooms, "monitor", seed) for seed in range(400)]
    assert len({*drawn}) > 300
    assert np.mean(np.array(drawn) == 0) == pytest.approx(0.05, abs=0.03)
    result.sensor.metric = False
    assert floor("floor", plain) is None


@pytest.mark.parametrize("name", SUPPORTS)
def test_supports_are_drawn_in_their_shares(name):
    most, supports = SUPPORTS[name]
    rng = np.random.default_rng(0)
    drawn = np.array([draw_support(name, most, rng) for _ in range(4000)])
    for share, low, high in supports:
        assert ((drawn >= low) & (drawn < high)).mean() == pytest.approx(share, abs=0.03)
    assert (drawn == 0).mean() == pytest.approx(1 - sum(s for s, *_ in supports), abs=0.03)
    assert not any(draw_support(name, most + 0.01, rng) for _ in range(50))
