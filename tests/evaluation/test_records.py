import dataclasses
import json

import numpy as np
import pytest

from qs3.errors import InputError
from qs3.evaluation.records import load_records, read_record, score, write_record


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
        ("seed", None, "'seed' is missing"),
        ("scores.confusion", None, "'scores.confusion' is missing"),
        ("target.checksum", None, "'target.checksum' is missing"),
        ("colour", "red", "'colour' is unknown"),
        ("source.path", "/home", "'source.path' is unknown"),
        ("seed", "zero", "'seed' is a str"),
        ("seed", True, "'seed' is a bool"),
        ("marks", "supervised", "'marks' is a str"),
        ("scores", [1], "'scores' is a list"),
        ("scores.accuracy", "high", "'scores.accuracy' is a str"),
        ("schema", 99, "schema 99"),
    ],
)
def test_unknown_missing_and_mistyped_fields_are_named(record, tmp_path, field, new, message):
    path = write_record(tmp_path, record)
    value = json.loads(path.read_text())
    edit(value, field, new)
    path.write_text(json.dumps(value))
    with pytest.raises(InputError, match=message) as caught:
        read_record(path)
    assert "record.json" in str(caught.value)


def test_a_source_cannot_be_absent(record, tmp_path):
    path = write_record(tmp_path, record)
    value = json.loads(path.read_text()) | {"source": None}
    path.write_text(json.dumps(value))
    with pytest.raises(InputError, match="'source' is a NoneType"):
        read_record(path)


@pytest.mark.parametrize("text", ["", "[]", "3", "{"])
def test_a_damaged_record_is_named(tmp_path, text):
    (tmp_path / "record.json").write_text(text)
    with pytest.raises(InputError, match=r"record\.json"):
        read_record(tmp_path)


def test_records_are_found_below_a_folder_in_order(record, tmp_path):
    for seed in (2, 0, 1):
        changed = dataclasses.replace(record, seed=seed)
        write_record(tmp_path / "deep" / f"seed-{seed}", changed)
    assert [found.seed for found in load_records(tmp_path)] == [0, 1, 2]
    (tmp_path / "empty").mkdir()
    with pytest.raises(InputError, match="holds no record"):
        load_records(tmp_path / "empty")
    with pytest.raises(InputError, match="no such folder"):
        load_records(tmp_path / "nowhere")


def test_score_holds_together():
    scores = score(np.array([0, 0, 2, 2]), np.array([0, 2, 2, -1]), ["a", "b", "c"])
    assert scores.per_class == (0.5, None, 0.5)
    assert scores.confusion == ((1, 0, 1, 0), (0, 0, 0, 0), (0, 0, 1, 1))
    assert sum(map(sum, scores.confusion)) == scores.clouds == 4
    assert scores.interval[0] < scores.accuracy < scores.interval[1]
    with pytest.raises(InputError, match="no cloud"):
        score(np.zeros(0, dtype=int), np.zeros(0, dtype=int), ["a"])
