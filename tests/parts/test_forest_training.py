"""Runs of forests: trained, saved, asked and scored; target labels never reach them."""

import dataclasses
import json
import subprocess
import sys

import numpy as np
import pytest
import safetensors.numpy

from qs3.answers import Classifier, evaluate
from qs3.answers.answer import load_trained
from qs3.clouds.types import Origin, PointClouds
from qs3.errors import InputError
from qs3.parts import forest_training as forest
from qs3.parts.descriptor import WIDTH
from qs3.runs import PRESETS, SelfTrainingSettings, TrainSettings, read_run

from ..clouds.hostile import refused
from ..stores import train_forest
from ..training.common import make_clouds

SETTINGS = TrainSettings(model="forest")
ROUNDS = SelfTrainingSettings(rounds=2, threshold_share=0.5)


@pytest.fixture(scope="module", autouse=True)
def few_trees():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("qs3.parts.forest.TREES", 60)
        yield


def scans(count=30, seed=0, noise=0.02) -> PointClouds:
    clouds = make_clouds(count, seed, noise, points=200)
    return dataclasses.replace(clouds, points=clouds.points * np.float32(0.05))


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("forest") / "run"
    target = scans(24, 1).without_labels()
    result = train_forest("qbst", scans(), target, SETTINGS, ROUNDS, run_dir=folder)
    return folder, result


def test_a_run_predicts_as_it_was_trained_and_scores(run):
    folder, result = run
    test = scans(12, 7)
    classifier = Classifier.load(folder)
    assert classifier.class_names == test.class_names
    assert classifier.predict_proba(test) == pytest.approx(
        load_trained(folder / "forest.safetensors").describe(test.points).probabilities
    )
    record = evaluate(folder, scans(24, 1))
    assert (record.model, record.method) == ("forest", "qbst")
    assert record.scores.accuracy > 0.9
    assert record.marks == ("transductive",)
    assert sum(record.rounds[0]["right"]) == sum(record.rounds[0]["known"]) > 0
    assert len(result.held_out.rows) == 30
    assert result.held_out.accuracy == 1


def test_what_is_known_is_measured_after_the_rounds(tmp_path, monkeypatch):
    """By forests that learn what the rounds selected too, as the one that answers does."""
    learners, cross_validate = [], forest._cross_validate

    def watched(learner, *rest):
        learners.append(learner)
        return cross_validate(learner, *rest)

    monkeypatch.setattr(forest, "_cross_validate", watched)
    target = scans(24, 1).without_labels()
    result = train_forest("qbst", scans(), target, SETTINGS, ROUNDS, run_dir=tmp_path / "run")
    (learner,) = learners
    selected = sum(result.rounds[-1].kept)
    assert len(learner.labels) == len(scans()) + selected > len(scans())
    again = cross_validate(learner, scans().scan_rows(), SETTINGS.seed)
    kept = load_trained(tmp_path / "run").known
    assert kept == dataclasses.replace(again.known, temperature=1.0)


def test_objects_between_two_classes_are_unknown(run):
    classifier, test = Classifier.load(run[0]), scans(60, 9)
    blends = dataclasses.replace(test, points=test.points * np.float32([1, 1, 2.5]))
    known, unsure = (
        (classifier.predict(clouds, unknown=0.1) == "unknown").mean() for clouds in (test, blends)
    )
    assert known < 0.5
    assert unsure > known


@pytest.mark.parametrize("method", ["qbst", "spst"])
def test_labels_of_the_target_change_nothing(tmp_path, method):
    target = scans(24, 1)
    poisoned = dataclasses.replace(target, labels=(target.labels + 1) % 3)
    shares = []
    for name, clouds in (("right", target), ("poisoned", poisoned)):
        rounds = dataclasses.replace(ROUNDS, rule=method)
        folder = tmp_path / name
        train_forest(method, scans(), clouds.without_labels(), SETTINGS, rounds, run_dir=folder)
        shares.append((folder / "forest.safetensors").read_bytes())
    assert shares[0] == shares[1]
    with pytest.raises((InputError, TypeError, ValueError)):
        train_forest(method, scans(), target, SETTINGS, ROUNDS, run_dir=tmp_path / "labelled")


def test_rounds_learn_a_domain_whose_sizes_drift(tmp_path):
    """A class that is smaller in the target than in the source is found by what is sure."""
    source, target = scans(60, noise=0.02), scans(60, 5, noise=0.02)
    target = dataclasses.replace(target, points=target.points * np.float32(0.9))
    plain = train_forest("source-only", source, None, SETTINGS, run_dir=tmp_path / "plain")
    adapted = train_forest(
        "qbst", source, target.without_labels(), SETTINGS, ROUNDS, run_dir=tmp_path / "adapted"
    )
    assert not plain.rounds
    assert [record.skipped for record in adapted.rounds] == [False, False]
    right = [evaluate(tmp_path / name, target).scores.accuracy for name in ("plain", "adapted")]
    assert right[1] >= right[0]


@pytest.mark.parametrize(
    ("change", "fault"),
    [({"epochs": 3}, "epochs"), ({"rule": "source-val"}, "rule"), ({"threads": 2}, "threads")],
)
def test_settings_of_networks_are_refused(tmp_path, change, fault):
    settings = dataclasses.replace(SETTINGS, **change)
    with pytest.raises(InputError, match=fault):
        train_forest("source-only", scans(), None, settings, run_dir=tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_rounds_that_mix_presets_are_refused(tmp_path):
    """Settings that a forest does not read come from one preset, or a user would believe them."""
    mixed = dataclasses.replace(PRESETS["gentle"], epochs=10)
    arguments = ("qbst", scans(), scans(6).without_labels(), SETTINGS)
    with pytest.raises(InputError, match="epochs = 10 of the rounds needs a network"):
        train_forest(*arguments, mixed, run_dir=tmp_path / "run")


@pytest.mark.parametrize("method", ["gast", "gast-spst"])
def test_methods_of_networks_are_refused(tmp_path, method):
    target = scans(6).without_labels()
    with pytest.raises(InputError, match="needs a network"):
        train_forest(method, scans(), target, SETTINGS, run_dir=tmp_path / "run")


@pytest.mark.parametrize(
    ("name", "value", "fault"),
    [
        ("left", 10**6, "left"),
        ("left", 0, "left"),
        ("feature", WIDTH, "feature"),
        ("roots", -1, "roots"),
        ("threshold", np.nan, "finite"),
        ("value", -0.5, "add up to 1"),
        ("value", 0.0, "add up to 1"),
    ],
)
def test_a_damaged_forest_is_refused(run, tmp_path, name, value, fault):
    path, arrays, facts = opened(run, tmp_path)
    row = 0 if name == "roots" else int(np.flatnonzero(arrays["feature"] >= 0)[0])
    arrays[name][row] = value
    safetensors.numpy.save_file(arrays, path, {"qs3": json.dumps(facts)})
    with refused(fault, path):
        load_trained(path)


def opened(run, tmp_path):
    """Return where a damaged forest may be written, the arrays of a sound one, and its facts."""
    with safetensors.safe_open(run[0] / "forest.safetensors", framework="numpy") as handle:
        arrays = {name: handle.get_tensor(name) for name in handle.keys()}  # noqa: SIM118
        return tmp_path / "forest.safetensors", arrays, json.loads(handle.metadata()["qs3"])


@pytest.mark.parametrize(
    ("fact", "value", "fault"),
    [
        *(("known", value, "train the run again|not") for value in (
            {"temperature": 1e-300}, {"temperature": -1.0}, {"temperature": "1"},
            {"energies": [1e308]}, {"clouds": 0},
        )),
        *(("sizes", value, "train the run again|not") for value in (
            [1e-300, 1.0], [0.1, 1e300], [-1.0, 1.0], [0.1],
        )),
        *(("width", value, f"reads {value} numbers of a cloud, not {WIDTH}")
          for value in (WIDTH - 1, WIDTH + 1, 10**9)),
        ("class_names", ["ball", "ball", "rod"], "named twice"),
        ("class_names", ["ball", "", "rod"], "is empty"),
        ("class_names", ["ball", "rod"], "do not fit"),
    ],
)  # fmt: skip
def test_damaged_facts_are_refused_when_the_run_is_read(run, tmp_path, fact, value, fault):
    path, arrays, facts = opened(run, tmp_path)
    facts[fact] = facts[fact] | value if isinstance(value, dict) else value
    safetensors.numpy.save_file(arrays, path, {"qs3": json.dumps(facts)})
    with refused(fault, path):
        load_trained(path)


def test_predicting_imports_neither_torch_nor_scikit_learn(run, tmp_path):
    np.save(tmp_path / "cloud.npy", scans(1).points[0])
    code = (
        "import sys; from qs3.cli import main\n"
        "try: main(sys.argv[1:])\n"
        "except SystemExit as ended: assert not ended.code\n"
        "print(*(name for name in ('torch', 'sklearn', 'trimesh') if name in sys.modules))"
    )
    words = ["predict", str(run[0]), str(tmp_path / "cloud.npy"), "--unknown", "0.1"]
    done = subprocess.run(
        [sys.executable, "-c", code, *words], capture_output=True, text=True, check=True
    )
    answer, loaded = done.stdout.splitlines()
    assert "cloud.npy" in answer
    assert loaded == ""


def test_a_few_labels_mend_a_class_and_have_a_name_of_their_own(tmp_path):
    """The target is four times as wide as the source: labels tell."""
    target = scans(30, 1)
    target = dataclasses.replace(target, points=target.points * np.float32([4, 4, 1]))
    few = target.select(np.arange(6))
    rest = target.select(np.arange(6, 30))
    for name, labelled in (("plain", None), ("few", few)):
        train_forest(
            "source-only", scans(), None, SETTINGS, run_dir=tmp_path / name, labelled=labelled
        )
    plain, mended = (evaluate(tmp_path / name, rest) for name in ("plain", "few"))
    assert mended.scores.accuracy > plain.scores.accuracy + 0.2
    assert (plain.method, mended.method) == ("source-only", "few-label")
    assert evaluate(tmp_path / "few", few).marks == ("training clouds",)
    with pytest.raises(InputError, match="another --labels"):
        train_forest(
            "source-only", scans(), None, SETTINGS, run_dir=tmp_path / "few", labelled=rest
        )


def test_labelled_scans_in_another_unit_are_refused(tmp_path):
    """One of six costs all, or the forest would learn from it."""
    factors = np.float32([1, 1, 1000, 1, 1, 1])[:, None, None]
    far = dataclasses.replace(scans(6, 1), points=scans(6, 1).points * factors)
    with pytest.raises(InputError, match=f"^{far.ids[2]}: points are to be in metres"):
        train_forest("source-only", scans(), None, SETTINGS, run_dir=tmp_path, labelled=far)


def test_a_scan_is_judged_by_forests_that_saw_neither_it_nor_its_twin(tmp_path, rng):
    """Its class is drawn by lot, so that only its twin could show it."""
    some = scans()
    twice = PointClouds(
        np.tile(some.points, (2, 1, 1)), np.tile(rng.permutation(some.labels), 2), some.class_names,
        tuple(f"{name}/{kind}" for kind in ("points", "clean") for name in some.ids),
        origin=Origin("store", cloud="all"),
    )  # fmt: skip
    held_out = train_forest("source-only", twice, None, SETTINGS, run_dir=tmp_path).held_out
    assert held_out.rows.tolist() == [*range(30)]
    assert held_out.accuracy < 0.7


@pytest.mark.parametrize("where", ["source", "target", "labelled"])
def test_scans_of_one_place_are_refused(tmp_path, where):
    """A forest would learn, or answer, a class from them."""
    some = scans(6, 1)
    points = some.points.copy()
    points[2] = points[2, 0]
    few = dataclasses.replace(some, points=points)
    clouds = {"source": scans(), "target": None, "labelled": None, where: few}
    source, target, labelled = clouds.values()
    target = target and target.without_labels()
    with pytest.raises(InputError, match=rf"^{where}: cloud \S*2: fewer than 12 distinct"):
        train_forest("source-only", source, target, SETTINGS, run_dir=tmp_path, labelled=labelled)


def test_labelled_scans_get_no_pseudo_label(tmp_path):
    target = scans(24, 1)
    options = {"run_dir": tmp_path / "run", "labelled": target.select(np.arange(4))}
    result = train_forest("qbst", scans(), target.without_labels(), SETTINGS, ROUNDS, **options)
    assert result.rounds[0].pool == 20
    assert read_run(tmp_path / "run").method == "few-label+qbst"
