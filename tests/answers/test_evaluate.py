"""Runs and their scores, made in Python."""

import dataclasses
import json
import unicodedata
from dataclasses import replace

import numpy as np
import pytest

from qs3.answers import evaluate
from qs3.answers.answer import load_trained
from qs3.answers.scoring import records_path
from qs3.errors import InputError
from qs3.evaluation import read_records
from qs3.files import folder_lock
from qs3.runs import SelfTrainingSettings, is_run, read_run
from qs3.runs.run import RunSettings, claim_run
from qs3.training import fit
from qs3.training.predict import load_model

ROUNDS = SelfTrainingSettings(rounds=1, epochs=1, threshold=0.34)


def claim(folder, *of):
    """Begin a run, and leave it there."""
    with claim_run(folder, RunSettings.of(*of)):
        pass


pytestmark = pytest.mark.filterwarnings("ignore::qs3.adaptation.selection.SingleClassWarning")


def test_a_fitted_run_is_scored_on_any_clouds(source, target, settings, tmp_path):
    arguments = ("dann:DANN", source, target.without_labels(), replace(settings, validate_every=2))
    result = fit(*arguments, ROUNDS, run_dir=tmp_path / "run", preset="default", supervised=True)
    run = read_run(tmp_path / "run")
    assert (run.method, run.preset, run.selection) == ("dann:DANN+qbst", "default", "last")
    assert (run.source.name, run.source.clouds) == ("arrays", 24)
    assert len(run.rounds) == 1
    assert run.seconds["total"] == pytest.approx(run.seconds["source"] + run.seconds["rounds"])
    assert sum(record.steps for record in result.history) == run.steps["source"] > 0
    assert run.steps["total"] == run.steps["source"] + result.rounds[0].steps
    assert 0 < run.cpu_seconds["source"] < run.cpu_seconds["total"]
    assert len(result.source) == 24
    assert result.target.points.shape == (30, 64, 3)

    record = evaluate(tmp_path / "run", target, experiment={"row": "dann"})
    assert read_records(records_path(tmp_path / "run"))[0][-1][1] == record
    assert record.marks == ("transductive", "supervised")
    assert record.experiment == {"row": "dann"}
    assert (record.cpu_seconds, record.steps) == (run.cpu_seconds, run.steps)

    order = np.array([2, 0, 1])  # other numbers for the same names
    names = tuple(np.array(target.class_names)[np.argsort(order)])
    other = replace(target, labels=order[target.labels], class_names=names)
    assert evaluate(tmp_path / "run", other).scores == record.scores
    with pytest.raises(InputError, match="sofa"):
        evaluate(tmp_path / "run", replace(target, class_names=("ball", "disc", "sofa")))


def test_a_run_of_own_classes_is_scored_by_a_map_on_data_that_merge_them(
    source, target, settings, tmp_path
):
    names = ("chair", "armchair", "rod")  # two of which PointDA-10 would merge
    renamed = replace(source, class_names=names)
    fit("source-only", renamed, None, replace(settings, epochs=1), run_dir=tmp_path / "run")
    assert load_model(tmp_path / "run").class_names == names
    fine = evaluate(tmp_path / "run", replace(target, class_names=names))
    assert (fine.scores.class_names, fine.test.renamed) == (names, {})

    merged = replace(target, labels=target.labels // 2, class_names=("seat", "rod"))
    with pytest.raises(InputError, match="'seat' is not one of: chair, armchair, rod"):
        evaluate(tmp_path / "run", merged)
    called = {"chair": "seat", "armchair": "seat", "mug": "cup"}
    record = evaluate(tmp_path / "run", merged, class_map=called)
    assert record.scores.class_names == ("seat", "rod")
    assert record.test.renamed == {"chair": "seat", "armchair": "seat"}
    counts = np.array(fine.scores.confusion)[:, :3]  # the same answers, seats put together
    together = np.array([[1, 0], [1, 0], [0, 1]])
    expected = together.T @ counts @ together
    assert np.array_equal(np.array(record.scores.confusion)[:, :2], expected)
    assert read_records(records_path(tmp_path / "run"))[0][-1][1] == record
    with pytest.raises(InputError, match="the map of classes names mug, and none of chair"):
        evaluate(tmp_path / "run", replace(target, class_names=names), class_map={"mug": "cup"})


@pytest.mark.parametrize(("learnt", "tested"), [("NFC", "NFD"), ("NFD", "NFC")])
def test_class_names_are_one_in_either_form_of_unicode(
    source, target, settings, tmp_path, learnt, tested
):
    names = ("B\u00e4ll", "disc", "rod")
    first, second = (
        tuple(unicodedata.normalize(form, name) for name in names) for form in (learnt, tested)
    )
    assert first != second
    fit("source-only", replace(source, class_names=first), None, settings, run_dir=tmp_path / "run")
    data = replace(target, class_names=second)
    plain = evaluate(tmp_path / "run", replace(target, class_names=first)).scores.accuracy
    assert evaluate(tmp_path / "run", data).scores.accuracy == plain
    called = {second[0]: "sphere"}
    record = evaluate(tmp_path / "run", data, class_map=called)
    assert record.scores.accuracy == plain
    assert record.scores.class_names == ("sphere", "disc", "rod")


def test_a_warm_ups_clouds_count_as_seen(source, target, settings, tmp_path):
    fit("source-only", target, None, settings, run_dir=tmp_path / "warm", supervised=True)
    arguments = ("qbst", source, target.without_labels(), settings, ROUNDS)
    fit(*arguments, run_dir=tmp_path / "run", warm_up=tmp_path / "warm")
    marks = ("transductive", "supervised", "training clouds")
    assert evaluate(tmp_path / "run", target).marks == marks
    (tmp_path / "warm" / "run.json").unlink()
    fit(*arguments, run_dir=tmp_path / "other", warm_up=tmp_path / "warm")
    assert "warm-up of unknown origin" in evaluate(tmp_path / "other", target).marks


def test_an_unfinished_run_is_reported_as_such(source, settings, tmp_path):
    with pytest.raises(InputError, match="not a run of qs3"):
        read_run(tmp_path)
    claim(tmp_path, "source-only", source, None, settings, None)
    assert is_run(tmp_path)
    with pytest.raises(InputError, match="not finished"):
        read_run(tmp_path)


def test_the_folder_around_a_run_is_refused_with_the_name_of_the_run(source, settings, tmp_path):
    fit("source-only", source, None, replace(settings, epochs=1), run_dir=tmp_path / "run")
    for read in (read_run, load_trained):
        with pytest.raises(InputError, match=r"not a run of qs3; did you mean .*run\?$"):
            read(tmp_path)


def test_a_run_of_another_schema_and_an_unknown_field_are_refused(source, settings, tmp_path):
    fit("source-only", source, None, replace(settings, epochs=1), run_dir=tmp_path / "run")
    path = tmp_path / "run" / "run.json"
    stored = json.loads(path.read_text())
    for change, message in (({"schema": 2}, "schema 2 of a run, this version reads 3"),
                         ({"colour": "red"}, "'colour' is unknown")):  # fmt: skip
        path.write_text(json.dumps(stored | change))
        with pytest.raises(InputError, match=rf"run\.json.*{message}"):
            read_run(tmp_path / "run")


def test_other_data_are_reported_by_their_option(source, target, settings, tmp_path):
    bare = target.without_labels()
    claim(tmp_path, "dann:DANN", source, bare, settings, None)
    other = replace(source, points=source.points + 1)
    moved = replace(bare, points=bare.points + 1)
    for clouds, aim, message in (
        (other, bare, "another --source .*differ.*do the same as then"),
        (source, moved, "another --target"),
        (source, None, "begun with --target; name another folder, or do the same"),
    ):
        with pytest.raises(InputError, match=message) as caught:
            claim(tmp_path, "dann:DANN", clouds, aim, settings, None)
        assert str(tmp_path) in str(caught.value)


def test_one_training_at_a_time(source, settings, tmp_path):
    run = tmp_path / "run"
    fit("source-only", source, None, settings, run_dir=run)
    with folder_lock(run), pytest.raises(InputError, match="run: another qs3 is writing"):
        fit("source-only", source, None, settings, run_dir=run)
    seen = []
    fit("source-only", source, None, settings, run_dir=run, on_epoch=lambda r, m: seen.append(r))
    assert not seen

    def again(record, method):
        fit("source-only", source, None, settings, run_dir=tmp_path / "new")

    with pytest.raises(InputError, match="another qs3 is writing"):
        fit("source-only", source, None, settings, run_dir=tmp_path / "new", on_epoch=again)


def test_a_run_older_than_a_setting_continues(source, settings, tmp_path):
    claim(tmp_path, "source-only", source, None, settings, None)
    value = json.loads((tmp_path / "settings.json").read_text())
    del value["train"]["label_smoothing"]
    # Settings of earlier releases, unused.
    value["train"] |= {"ema_decay": None, "clip_norm": None, "schedule": "cosine"}
    value["train"]["preparation"]["height_input"] = True  # likewise, and on
    (tmp_path / "settings.json").write_text(json.dumps(value))
    claim(tmp_path, "source-only", source, None, settings, None)
    other = dataclasses.replace(settings, label_smoothing=0.1)
    with pytest.raises(InputError, match=r"holds a run with train\.label_smoothing = 0\.0, not"):
        claim(tmp_path, "source-only", source, None, other, None)


@pytest.mark.parametrize(
    ("name", "value"), [("schedule", "plateau"), ("clip_norm", 1.0), ("ema_decay", 0.9)]
)
def test_a_run_that_used_a_removed_setting_is_refused(source, settings, tmp_path, name, value):
    claim(tmp_path, "source-only", source, None, settings, None)
    path = tmp_path / "settings.json"
    stored = json.loads(path.read_text())
    stored["train"][name] = value
    path.write_text(json.dumps(stored))
    with pytest.raises(InputError, match=rf"settings\.json: {name} = .* this version lacks"):
        claim(tmp_path, "source-only", source, None, settings, None)
