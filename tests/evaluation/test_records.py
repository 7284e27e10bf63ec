import dataclasses
import json

import numpy as np
import pytest

from qs3.errors import InputError
from qs3.evaluation.records import find_records, read_record, score, write_record


def test_a_record_comes_back_as_it_was(record, tmp_path):
    path = write_record(tmp_path / "run", record)
    assert path.name == "record.json"
    assert read_record(path) == read_record(tmp_path / "run") == record
    assert write_record(tmp_path / "run", record) == path


def test_without_a_target(record, tmp_path):
    plain = dataclasses.replace(record, target=None, method="source-only", rounds=(), marks=())
    assert read_record(write_record(tmp_path / "a.json", plain)) == plain


def test_a_finished_record_is_not_overwritten(record, tmp_path):
    path = write_record(tmp_path, record)
    before = path.read_bytes()
    with pytest.raises(InputError, match="another run"):
        write_record(tmp_path, dataclasses.replace(record, seed=1))
    assert path.read_bytes() == before


def test_what_is_not_json_is_refused_and_nothing_is_written(record, tmp_path):
    for value in (float("nan"), {1, 2}, np.float32(1)):
        with pytest.raises(InputError, match="not plain JSON"):
            write_record(tmp_path, dataclasses.replace(record, settings={"a": value}))
    assert not list(tmp_path.iterdir())


def edit(value, path, new):
    *parents, last = path.split(".")
    place = value
    for name in parents:
        place = place[name]
    if new is None:
        del place[last]
    else:
        place[last] = new


@pytest.mark.parametrize(
    ("field", "new", "message"),
    [
        ("seed", None, "'seed'"),
        ("target.checksum", None, "'target.checksum'"),
        ("colour", "red", "'colour'"),
        ("source.path", "/home", "'source.path'"),
        ("seed", True, "'seed'"),
        ("scores.accuracy", 0.9, "'scores.accuracy'"),
        ("scores.clouds", 9, "'scores.clouds'"),
        ("schema", 99, "schema 99"),
        ("schema", True, "schema True"),
    ],
)
def test_a_field_that_cannot_be_is_named(record, tmp_path, field, new, message):
    path = write_record(tmp_path, record)
    value = json.loads(path.read_text())
    edit(value, field, new)
    path.write_text(json.dumps(value))
    with pytest.raises(InputError, match=rf"record\.json.*{message}"):
        read_record(path)


def test_records_of_older_schemas_are_brought_up_to_date(record, tmp_path):
    """Schema 1 had no choices; up to 2 a teacher was a labeller, and qbst was qs3 on scans."""
    now = dataclasses.replace(record, settings={"method": "qbst", "self_training": {"teacher": 1}})
    value = json.loads(write_record(tmp_path / "now.json", now).read_text())
    del value["experiment"]
    value |= {"method": "qs3", "schema": 2}
    value["settings"] = {"method": "qs3", "self_training": {"labeller": 1}}
    for schema in (2, 1):
        path = tmp_path / f"{schema}.json"
        path.write_text(json.dumps(value | {"schema": schema}))
        assert read_record(path) == now
        value.pop("choices", None)


@pytest.mark.parametrize("text", ["", "[]", "3", "{"])
def test_a_damaged_record_is_named(tmp_path, text):
    (tmp_path / "record.json").write_text(text)
    with pytest.raises(InputError, match=r"record\.json"):
        read_record(tmp_path)


def test_records_are_found_below_a_folder_in_order(record, tmp_path):
    for seed in (2, 0, 1):
        changed = dataclasses.replace(record, seed=seed)
        write_record(tmp_path / "deep" / f"seed-{seed}", changed)
    (tmp_path / "deep" / "seed-2" / "records").mkdir()
    (tmp_path / "deep" / "seed-2" / "records" / "a.json").write_text("{}")
    (tmp_path / "deep" / "other.json").write_text("{}")
    records, faults = find_records(tmp_path)
    assert [made.seed for _, made in records] == [0, 1, 2]
    assert len(faults) == 1
    with pytest.raises(InputError, match="no such folder"):
        find_records(tmp_path / "nowhere")


def test_score_holds_together():
    scores = score(np.array([0, 0, 2, 2]), np.array([0, 2, 2, -1]), ["a", "b", "c"])
    assert scores.per_class == (0.5, None, 0.5)
    assert scores.confusion == ((1, 0, 1, 0), (0, 0, 0, 0), (0, 0, 1, 1))
    assert sum(map(sum, scores.confusion)) == scores.clouds == 4
    assert scores.interval[0] < scores.accuracy < scores.interval[1]
    with pytest.raises(InputError, match="no cloud"):
        score(np.zeros(0, dtype=int), np.zeros(0, dtype=int), ["a"])
