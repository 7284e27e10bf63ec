"""From a folder of runs and records to the contents of a page."""

import dataclasses
import json
import shutil

import numpy as np
import pytest

from qs3.errors import InputError
from qs3.evaluation.records import read_record, write_record
from qs3.files import read_json
from qs3.io import load_clouds
from qs3.report.collect import collect, look
from qs3.report.lookup import read_domain
from qs3.report.page import render
from qs3.report.settings import ReportSettings
from qs3.training import load_model


@pytest.fixture(scope="module")
def page(grid):
    """What is told of the whole grid."""
    return collect(look(grid), ReportSettings())


def records_of(folder):
    return sorted((folder / "records").iterdir())


def test_the_adapted_run_is_told_in_full_with_its_warm_up_and_its_data(grid, page):
    report, faults = page
    assert faults == ()
    assert [network.name for network in report.networks] == ["source-only", "qbst"]
    assert all(len(network.right) == 12 for network in report.networks)
    recorded = read_record(records_of(grid / "second")[0])
    assert report.after.scores == recorded.scores
    assert {domain: len(clouds) for domain, clouds in report.clouds.items()} == {
        "source": 12,
        "target": 12,
    }
    assert report.clouds["target"][0].note.endswith("(qbst)")
    assert [m.name for m in report.maps] == ["source-only", "qbst"]
    assert {curve.panel for curve in report.curves} == {"loss", "accuracy in training"}
    assert len(report.rounds) == len(report.marks) == 2
    assert [line.name for line in report.scores] == ["source-only", "qbst"]
    assert report.data["test"].checksum == recorded.test.checksum
    assert report.notes[0].startswith("Transductive: ")
    assert "It is second, one of 2 runs" in report.summary
    assert str(grid) not in render(dataclasses.replace(report, curves=(), clouds={}))


def test_one_run_alone_has_no_before_and_after(grid, tmp_path):
    shutil.copytree(grid / "first", tmp_path / "plain")
    settings = ReportSettings(data=str(grid / "shapes"), clouds=0)
    report, _ = collect(look(tmp_path / "plain"), settings)
    assert (report.before, report.after.name) == (None, "source-only")
    assert report.notes[0].startswith("Training clouds: ")
    assert report.clouds == {}


def test_records_alone_make_tables_and_no_clouds(grid, tmp_path):
    for name, row in (("first", "source-only"), ("second", "qbst")):
        record = read_record(records_of(grid / name)[0])
        place = {"source": "S", "target": "D", "row": row, "seed": 0} if row == "qbst" else None
        record = dataclasses.replace(record, experiment=place)
        # An older record has no fields: its file's name alone tells them.
        write_record(tmp_path / f"S-D_{row}_seed-0.json", record)
    published = {"S-D": {"qbst": "72.4 ± 0.8"}}
    report, _ = collect(look(tmp_path, published), ReportSettings())
    assert [network.name for network in report.networks] == ["source-only", "qbst"]
    assert {(line.name, line.published) for line in report.scores} == {
        ("S-D source-only", ""),
        ("S-D qbst", "72.4 ± 0.8"),
    }
    assert not report.clouds
    assert len(report.rounds) == 2


@pytest.mark.parametrize("damage", ["truncated", "foreign", "matrix", "rounds", "unfinished"])
def test_what_cannot_be_read_is_named_and_the_rest_is_found(grid, tmp_path, damage):
    folder = tmp_path / "grid"
    shutil.copytree(grid, folder)
    bad = folder / "first" / "records" / "extra.json"
    whole = records_of(folder / "second")[0].read_text("utf-8")
    record = json.loads(whole)
    if damage == "unfinished":
        bad = folder / "third"
        bad.mkdir()
        shutil.copy(folder / "first" / "settings.json", bad)
    elif damage == "truncated":
        bad.write_text(whole[:200])
    else:
        record |= {"stranger": 1} if damage == "foreign" else {}
        if damage == "matrix":
            record["scores"]["confusion"][0].pop()
        if damage == "rounds":
            del record["rounds"][0]["kept"]
        bad.write_text(json.dumps(record))
    holdings = look(folder)
    assert len(holdings.faults) == 1
    assert str(bad) in holdings.faults[0]
    assert len(holdings.runs) == len(holdings.records) == 2


def test_what_is_left_out_is_told_on_the_page(grid, tmp_path):
    shutil.copytree(grid / "first", tmp_path / "first")
    (tmp_path / "first" / "records" / "extra.json").write_text("{")
    report, faults = collect(look(tmp_path), ReportSettings(clouds=0))
    assert len(faults) == 1
    assert report.notes[-1] == "1 run or record could not be used; not on this page."


def test_folders_without_anything_to_tell_are_refused(grid, tmp_path):
    with pytest.raises(InputError, match="no such folder"):
        look(tmp_path / "none")
    with pytest.raises(InputError, match="neither a finished run nor a record"):
        look(tmp_path)
    shutil.copytree(grid / "first", tmp_path / "unfinished")
    (tmp_path / "unfinished" / "model.safetensors").unlink()
    with pytest.raises(InputError, match="not finished"):
        look(tmp_path / "unfinished")
    other = tmp_path / "other" / "spoon"
    other.mkdir(parents=True)
    np.savetxt(other / "a.xyz", np.eye(3))
    for given, word in ((other.parent, "spoon"), (tmp_path / "gone", "gone")):
        with pytest.raises(InputError, match=word):
            collect(look(grid / "first"), ReportSettings(data=str(given)))


def test_data_that_changed_since_are_not_taken_for_those_of_the_record(grid, tmp_path):
    for name in ("first", "second"):
        shutil.copytree(grid / name, tmp_path / name)
    (tmp_path / "shapes" / "chair").mkdir(parents=True)
    np.savetxt(tmp_path / "shapes" / "chair" / "a.xyz", np.eye(3))
    report, _ = collect(look(tmp_path), ReportSettings())
    assert "not at hand: --data shows them" in report.notes[-1]
    assert not report.clouds
    assert [network.name for network in report.networks] == ["source-only", "qbst"]  # of records


def test_data_are_read_as_the_run_and_its_record_read_them(grid, tmp_path):
    """A score on other clouds than the record's would pass for the record's."""
    folder = tmp_path / "run"
    shutil.copytree(grid / "second", folder)
    values = read_json(folder / "run.json")
    values["source"]["cloud"] = "surface"
    (folder / "run.json").write_text(json.dumps(values))
    (path,) = records_of(folder)
    values = read_json(path)
    values["test"]["cloud"] = "clean"
    path.write_text(json.dumps(values))
    holdings = look(folder)
    run, record = holdings.runs[0], holdings.records[0].record
    loaded, data = load_model(folder), str(grid / "shapes")
    kinds = {
        load_clouds(data, num_points=24, cloud=kind).checksum: kind
        for kind in ("points", "clean", "surface")
    }
    assert len(kinds) == 3

    def read(recorded, cloud=None):
        return kinds[read_domain((data, None, cloud), recorded, folder, loaded).clouds.checksum]

    assert [read(run.source), read(record.test), read(run.target)] == ["surface", "clean", "points"]
    assert read(record.test, "points") == "points"
    report, _ = collect(holdings, ReportSettings(data=data, clouds=0))
    assert "Scored on 12 clouds of shapes (clean)." in report.summary
    assert "labelled clouds of shapes (surface)" in report.summary


def test_data_without_twins_are_read_whatever_the_record_says(grid, tmp_path):
    """Real scans have one cloud, and are what a network trained on clean twins is tested on."""
    (tmp_path / "scans" / "chair").mkdir(parents=True)
    np.savetxt(tmp_path / "scans" / "chair" / "a.xyz", np.eye(3))
    test = read_record(records_of(grid / "first")[0]).test
    recorded = dataclasses.replace(test, cloud="clean")
    loaded = load_model(grid / "first")._replace(class_names=("chair",))
    clouds = read_domain((str(tmp_path / "scans"), None, None), recorded, tmp_path, loaded)
    assert clouds.clouds.origin.cloud == "points"


@pytest.mark.parametrize(
    ("given", "word"),
    [({"cloud": "clean"}, "--cloud goes with --data"), ({"clouds": -1}, "--clouds -1"),
     ({"source_split": "test"}, "--source-split goes with --source")],
)  # fmt: skip
def test_settings_that_cannot_be_meant_are_refused(given, word):
    with pytest.raises(InputError, match=word):
        ReportSettings(**given)
