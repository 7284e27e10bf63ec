"""From the folder of a run to the contents of a page."""

import dataclasses
import json
import shutil

import numpy as np
import pytest

from qs3.answers import evaluate
from qs3.answers.answer import load_trained
from qs3.clouds.load import load_clouds
from qs3.errors import InputError
from qs3.evaluation.records import RECORDS, read_records
from qs3.files import read_json
from qs3.report import page
from qs3.report.collect import _summary, answer_scans, collect
from qs3.report.page import render
from qs3.report.plots import confusion_heatmap
from qs3.runs import read_run
from qs3.runs.run import FOREST_MODEL


def test_run_has_scores_curves_rounds_and_clouds(grid):
    data = str(grid / "shapes")
    report = collect(grid / "second", data=data, source=data, before=grid / "first")
    assert list(report.scores) == ["first (before)", "qbst"]
    ((_, recorded),), _ = read_records(grid / "second" / RECORDS)
    assert report.scores["qbst"] == recorded.scores
    assert {domain: len(clouds) for domain, clouds in report.clouds.items()} == {
        "source": 12,
        "target": 12,
    }
    assert "qbst: " in report.clouds["target"][0].note
    assert {curve.panel for curve in report.curves} == {"loss", "accuracy in training"}
    assert len(report.rounds) == len(report.marks) == 2
    assert report.settings["data"]["test"]["checksum"] == recorded.test.checksum
    assert report.notes[0].startswith("Transductive: ")
    assert "Scored on 12 clouds of shapes." in report.summary
    assert "; seed 0. The network is that of the end of the training. Scored" in report.summary
    assert str(grid) not in render(dataclasses.replace(report, curves=(), clouds={}))


def test_without_data_the_scores_are_those_of_the_last_record(grid):
    report = collect(grid / "second", before=grid / "first")
    assert list(report.scores) == ["first (before)", "qbst"]
    assert report.clouds == {}
    part = collect(grid / "first", data=str(grid / "shapes"), cloud="clean", clouds=0)
    assert "Scored on 12 clouds of shapes (clean)." in part.summary and part.clouds == {}
    assert list(collect(grid / "first").scores) == ["source-only"]


def test_the_summary_says_which_network_is_kept_and_nothing_of_a_forest(grid):
    run = read_run(grid / "first")
    chosen = _summary(dataclasses.replace(run, selection="source-val"), None)
    wanted = (
        "The network is the checkpoint that was most accurate on held-out clouds of the source."
    )
    assert chosen.endswith(wanted)
    train = run.settings["train"] | {"model": FOREST_MODEL}
    forest = _summary(dataclasses.replace(run, settings={"train": train}), None)
    assert forest.endswith("; seed 0.")


def test_scans_are_shown_by_the_answered_class(grid, tmp_path):
    clouds = load_clouds(grid / "shapes").points
    for row in range(3):
        np.savetxt(tmp_path / f"scan-{row}.xyz", clouds[row])
    loaded = load_trained(grid / "first")
    answers = loaded.describe(clouds[:3]).probabilities.argmax(axis=1)
    answered = answer_scans(grid / "first", tmp_path)
    ((domain, shown),) = collect(grid / "first", scans=answered, below=tmp_path).clouds.items()
    assert domain == "scans, by answer"
    assert {cloud.note.partition(":")[0]: cloud.class_name for cloud in shown} == {
        f"scan-{row}.xyz": loaded.class_names[answer] for row, answer in enumerate(answers)
    }


def test_the_confusion_matrix_has_the_classes_of_a_map(grid, tmp_path, monkeypatch):
    shutil.copytree(grid / "first", tmp_path / "run")
    record = evaluate(tmp_path / "run", str(grid / "shapes"), class_map={"bed": "chair"})
    assert record.scores.class_names == ("chair", "sofa")
    labelled = []

    def drawn(counts, names, title):
        labelled.append((tuple(map(tuple, counts)), names))
        return confusion_heatmap(counts, names, title)

    monkeypatch.setattr(page, "confusion_heatmap", drawn)
    page._template.cache_clear()
    render(collect(tmp_path / "run"))
    page._template.cache_clear()
    assert labelled == [(record.scores.confusion, record.scores.class_names)]


def test_the_record_of_a_run_is_found_among_those_of_others(grid, tmp_path):
    place = tmp_path / "made" / "all.jsonl"
    for name, cloud in (("first", "clean"), ("second", "points"), ("first", "points")):
        evaluate(grid / name, str(grid / "shapes"), cloud=cloud, records=place)
    evaluate(grid / "second", str(grid / "shapes"), cloud="clean", records=place)
    ((_, _), (_, _), (_, first), (_, second)), _ = read_records(place)
    assert collect(grid / "first", records=place).scores == {"source-only": first.scores}
    assert collect(grid / "second", records=place).scores["qbst"] == second.scores
    assert "shapes (clean)" in collect(grid / "second", records=place).summary
    foreign = tmp_path / "other.jsonl"
    evaluate(grid / "first", str(grid / "shapes"), records=foreign)
    with pytest.raises(InputError, match=r"other\.jsonl: holds no record of .*second"):
        collect(grid / "second", records=foreign)
    with pytest.raises(InputError, match="no such file"):
        collect(grid / "second", records=tmp_path / "absent.jsonl")


def test_run_without_a_record_has_no_scores(grid, tmp_path):
    shutil.copytree(grid / "first", tmp_path / "run")
    (tmp_path / "run" / RECORDS).unlink()
    report = collect(tmp_path / "run")
    assert report.scores == {}
    assert report.curves


def test_unreadable_runs_and_data_are_refused(grid, tmp_path):
    with pytest.raises(InputError, match="none"):
        collect(tmp_path / "none")
    shutil.copytree(grid / "second", tmp_path / "unfinished")
    (tmp_path / "unfinished" / "model.safetensors").unlink()
    with pytest.raises(InputError, match="not finished"):
        collect(tmp_path / "unfinished")
    other = tmp_path / "other" / "spoon"
    other.mkdir(parents=True)
    np.savetxt(other / "a.xyz", np.eye(3))
    for place, word in ((other.parent, "spoon"), (tmp_path / "gone", "gone")):
        with pytest.raises(InputError, match=word):
            collect(grid / "first", data=str(place))


@pytest.mark.parametrize("damage", ["record", "round", "history"])
def test_damaged_files_of_a_run_are_named(grid, tmp_path, damage):
    folder = tmp_path / "run"
    shutil.copytree(grid / "second", folder)
    if damage == "record":
        bad = folder / RECORDS
        bad.write_text("{\n")
    elif damage == "round":
        bad = folder / "run.json"
        values = read_json(bad)
        del values["rounds"][0]["kept"]
        bad.write_text(json.dumps(values))
    else:
        bad = folder / "history.jsonl"
        bad.write_text('{"kind": "epoch"}\n')
    with pytest.raises(InputError, match=bad.name):
        collect(folder)
