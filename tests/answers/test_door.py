"""Every verb gives one answer to a cloud, and one fault: a folder with good and bad clouds."""

import json
import re
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from qs3 import load
from qs3.answers import Classifier, evaluate
from qs3.answers.answer import answer, load_trained
from qs3.answers.cloud_files import ListedCloud, list_clouds, read_each
from qs3.errors import InputError
from qs3.objects.segment import SegmentedObject
from qs3.report.collect import answer_scans, collect
from qs3.report.view import open_items
from qs3.runs import TrainSettings
from qs3.training import predict as networks
from qs3.workflow.suggest import suggest
from qs3.workflow.watch import SeenFrame, predict_objects, rows

from ..clouds.hostile import refused
from ..parts.test_forest_training import few_trees as few_trees
from ..parts.test_forest_training import scans
from ..stores import train_forest

BAD = ("empty", "few", "lost", "outsize", "unreadable")


@pytest.fixture(scope="module")
def forest(tmp_path_factory):
    run = tmp_path_factory.mktemp("door") / "forest"
    train_forest("source-only", scans(), None, TrainSettings(model="forest"), run_dir=run)
    return run


@pytest.fixture(params=["forest", "rooms"])
def run(request, forest, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return forest if request.param == "forest" else Path("rooms")


@pytest.fixture
def folder(run, tmp_path):
    """A class folder with two good clouds, of several numbers of points, and five bad ones."""
    rng = np.random.default_rng(0)
    name = load_trained(run).class_names[0]
    size = 0.05 if run.name == "forest" else 0.7
    place = tmp_path / "scans" / name
    place.mkdir(parents=True)
    for good, count in (("good", 300), ("better", 700)):
        np.save(place / f"{good}.npy", rng.random((count, 3)) * [size, size / 2, size / 3])
    np.save(place / "outsize.npy", rng.random((300, 3)) * 700)
    np.save(place / "few.npy", np.eye(3)[[0, 1, 2, 2, 2]] * size)
    np.save(place / "empty.npy", np.zeros((0, 3)))
    (place / "unreadable.ply").write_text("no PLY")
    (place / "lost.ply").symlink_to(place / "nowhere.ply")
    return tmp_path / "scans"


def stems(faults):
    """The files that faults name, each once."""
    return sorted(bad for fault in faults for bad in BAD if f"{bad}." in str(fault))


def test_all_verbs_give_the_same_answers_and_faults(run, folder, tmp_path):
    loaded, files = load_trained(run), list_clouds([folder])
    answered = {one.file: one for one in load(run).answers(files)}
    assert [*answered] == files
    faults = {file: one.fault for file, one in answered.items() if one.fault}
    assert sorted(file.stem for file in faults) == [*BAD]
    assert all(str(file) in fault for file, fault in faults.items())
    good = {file.stem: one for file, one in answered.items() if not one.fault}
    assert sorted(good) == ["better", "good"]
    # Python
    classifier = Classifier.load(run)
    whole = classifier.answers(folder)
    assert {one.file: one.fault for one in whole if one.fault} == faults
    assert [one.probabilities for one in whole] == [one.probabilities for one in answered.values()]
    with pytest.raises(InputError, match=r"5 of 7 clouds; answers\(\) returns the others"):
        classifier.predict(folder)
    two = [one.file for one in good.values()]
    assert classifier.predict(two).tolist() == [one.best()[0][0] for one in good.values()]
    # suggest
    picked, found = suggest(run, files, 9)
    assert sorted(map(str, found)) == sorted(faults.values())
    for one in picked:
        assert one.best() == good[one.file.stem].best()
    # evaluate
    found = []
    record = evaluate(run, folder, faults=found)
    assert stems(found) == [*BAD]
    assert "5 clouds left out" in record.marks
    right = [one.best()[0][0] == loaded.class_names[0] for one in good.values()]
    assert (record.scores.clouds, record.scores.accuracy) == (2, np.mean(right))
    with refused("empty"):
        evaluate(run, folder)
    # report
    page = collect(run, scans=answer_scans(run, folder))
    assert sorted(page.faults) == sorted(faults.values())
    assert page.total == 7
    (shown,) = page.clouds.values()
    for cloud in shown:
        stem = re.search(r"(\w+)\.npy", cloud.note)[1]
        ((name, share),) = good[stem].best()
        assert cloud.class_name == name
        assert cloud.note.endswith(f": {share:.0%}")
    page = collect(run, data=str(folder))
    assert stems(page.faults) == [*BAD]
    assert [scores.clouds for scores in page.scores.values()] == [2]
    # view
    items = open_items(str(run), str(folder))
    texts = [items.text(row) for row in range(len(items))]
    assert stems(items.faults) == ["empty", "lost", "unreadable"]
    for name, text in zip(items.names, texts, strict=True):
        stem = Path(name).stem
        if stem in good:
            ((best, share),) = good[stem].best()
            assert f"answer: {best} {share:.1%}" in text
        else:
            reason = faults[next(file for file in faults if file.stem == stem)]
            assert reason.rpartition(".npy ")[2].rpartition(": ")[2][:30] in text
    # watch
    seen = [cloud for cloud in read_each(files) if not cloud.fault]
    place = ((0.0,) * 3, (1.0,) * 3, 0.0, 1.0, 40.0, np.zeros(0, int))
    objects = [SegmentedObject(cloud.points, *place) for cloud in seen]
    frame = SeenFrame("0", None, predict_objects(loaded, objects))
    for cloud, line in zip(seen, rows(frame), strict=True):
        if cloud.path.stem in good:
            ((best, share),) = good[cloud.path.stem].best()
            assert (line["class"], line["confidence"]) == (best, pytest.approx(share, abs=1e-6))
        else:
            assert line["fault"]
            assert "class" not in line


def test_a_cloud_has_one_answer_alone_and_in_company(run, folder):
    loaded, files = load_trained(run), list_clouds([folder])
    whole = [*answer(loaded, read_each(files * 8))]  # more than one batch
    for file, one in zip(files * 8, whole, strict=True):
        (alone,) = answer(loaded, read_each([file]))
        assert one.fault == alone.fault
        assert list(one.probabilities) == list(alone.probabilities)
        shares = list(alone.probabilities.values())
        assert list(one.probabilities.values()) == pytest.approx(shares, abs=1e-6)


def test_a_network_answers_32_clouds_a_pass(monkeypatch):
    loaded, sizes = load_trained("rooms"), []
    encode = loaded.model.encode
    monkeypatch.setattr(
        loaded.model, "encode", lambda points: sizes.append(len(points)) or encode(points)
    )
    points = np.random.default_rng(0).random((70, 200, 3))
    assert len([*answer(loaded, (ListedCloud(Path("a"), cloud) for cloud in points))]) == 70
    assert sizes == [32, 32, 6]
    assert networks.describe(loaded.model, np.zeros((0, 9, 3), np.float32)).logits.shape == (0, 10)


def test_no_cloud_has_no_answer(run):
    classifier = Classifier.load(run)
    for none in (np.zeros((0, 100, 3)), [], ()):
        assert classifier.predict(none).shape == (0,)
        assert classifier.predict_proba(none).shape == (0, len(classifier.class_names))
        assert classifier.predict(iter(none), unknown=0.05).shape == (0,)
    assert [*answer(load_trained(run), [])] == []


class Witness:
    """CAD that is sure of the class that the run holds least likely."""

    def fusion_for(self, _):
        return SimpleNamespace(familiarity=lambda *_: 0.01)

    def look(self, probabilities, cloud, *_):
        if len(cloud) <= 300:
            raise InputError("no pose was found")
        names = dict.fromkeys(reversed(probabilities), 1.0)
        return SimpleNamespace(probabilities=names, candidates=(), best=None)


def test_cad_may_change_answers_and_its_faults_cost_one_cloud(run, folder):
    loaded = load_trained(run)
    seeing = type("Seeing", (type(loaded),), {"witness": Witness()})(**vars(loaded))
    clouds = [*read_each(list_clouds([folder]))]
    found = {one.file.stem: one for one in answer(seeing, clouds, unknown=0.05)}
    assert found["good"].fault.endswith("good.npy: no pose was found")
    assert sorted(stem for stem, one in found.items() if one.fault) == sorted([*BAD, "good"])
    assert found["better"].refused
    assert found["better"].familiarity == 0.01
    assert found["better"].best() == [("unknown", 1.0)]
    without = {one.file.stem: one for one in answer(seeing, clouds, pose=False)}
    assert sorted(stem for stem, one in without.items() if one.fault) == [*BAD]
    assert [*without["better"].probabilities] == [*found["better"].probabilities][::-1]


def test_verbs_finish_and_end_with_the_faults(run, folder, tmp_path, typed):
    table, entries = tmp_path / "answers.csv", tmp_path / "answers.json"
    printed = typed("predict", run, folder, "--top", 2, "--csv", table, "--json", entries,
                 "--sort-into", tmp_path / "sorted", code=2)  # fmt: skip
    assert [len(line.split("\t")) for line in printed.stdout.splitlines()] == [5, 5]
    assert "(5 of 7 files)" in printed.stderr.splitlines()[-1]
    assert len(json.loads(entries.read_text())) == 7
    assert len([*(tmp_path / "sorted").rglob("*.npy")]) == 2
    line = typed.refuses("predict", run, folder, "--sort-into", folder / "sorted")
    assert "and would be read with it" in line
    for words in (
        ("predict", run, folder),
        ("report", run, "--scans", folder, "--out", tmp_path / "page.html"),
        ("suggest", run, folder, "--out", tmp_path / "labels.csv"),
        ("evaluate", run, "--data", folder),
    ):
        printed = typed(*words, code=2).stderr
        assert all(f"{bad}." in printed for bad in BAD), (words, printed)
        assert "(5 of 7" in printed
    assert len(table.read_text().splitlines()) == 8
    assert (tmp_path / "page.html").is_file()
    assert len((tmp_path / "labels.csv").read_text().splitlines()) == 3


def test_a_run_in_the_place_of_the_clouds_is_named(run, tmp_path, typed):
    (tmp_path / "run.json").write_text("{}")
    for words in (("predict", run, tmp_path), ("suggest", run, tmp_path, "--out", "labels.csv")):
        assert "name the run first" in typed(*words, code=2).stderr
