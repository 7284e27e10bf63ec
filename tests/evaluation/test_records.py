import concurrent.futures
import dataclasses
import json
import threading

import numpy as np
import pytest

import qs3.evaluation.records as records_module
from qs3.errors import InputError
from qs3.evaluation.records import RECORDS, append_record, read_records, score


def test_records_come_back_as_they_were_and_once(record, tmp_path):
    path = tmp_path / "run" / RECORDS
    plain = dataclasses.replace(record, target=None, method="source-only", rounds=(), marks=())
    for one in (record, plain, record):
        append_record(path, one)
    assert read_records(path) == ([(f"{path}:1", record), (f"{path}:2", plain)], [])


def test_a_line_that_a_kill_cut_short_counts_as_not_written(record, tmp_path, caplog):
    path = tmp_path / RECORDS
    append_record(path, record)
    whole = path.read_bytes()
    path.write_bytes(whole + whole[:100])
    assert read_records(path) == ([(f"{path}:1", record)], [])
    assert f"{path}:2: the last line is cut short" in caplog.text
    other = dataclasses.replace(record, seed=1)
    append_record(path, other)
    assert [one for _, one in read_records(path)[0]] == [record, other]


@pytest.mark.parametrize(
    "text",
    ["mine", "mine\n", '{"image": 1}\n', '["a"]\n', "{head}mine\n", "{head}mine", "mine\n{head}"],
)
def test_a_file_of_the_user_is_no_file_of_records(record, tmp_path, text):
    path = tmp_path / "mine.jsonl"
    append_record(path, record)
    path.write_text(text.replace("{head}", path.read_text()))
    before = path.read_bytes()
    with pytest.raises(InputError, match=r"mine\.jsonl: is there already and holds no records"):
        append_record(path, dataclasses.replace(record, seed=1))
    assert path.read_bytes() == before


def test_several_processes_may_append(record, tmp_path):
    path = tmp_path / RECORDS
    records = [dataclasses.replace(record, seed=seed) for seed in range(40)]
    with concurrent.futures.ThreadPoolExecutor(8) as pool:
        list(pool.map(lambda one: append_record(path, one), records))
    found, faults = read_records(path)
    assert faults == [] and sorted(one.seed for _, one in found) == list(range(40))


def test_no_line_is_lost_while_another_process_repairs_the_file(record, tmp_path, monkeypatch):
    path = tmp_path / RECORDS
    records = [dataclasses.replace(record, seed=seed) for seed in range(3)]
    append_record(path, records[0])
    path.write_bytes(path.read_bytes() + b'{"method": "torn')
    write, threads = records_module.write_bytes, []

    def slow_write(*arguments):
        if not threads:
            threads.append(threading.Thread(target=append_record, args=(path, records[2])))
            threads[0].start()
            threads[0].join(0.5)
        write(*arguments)

    monkeypatch.setattr(records_module, "write_bytes", slow_write)
    append_record(path, records[1])
    threads[0].join()
    assert [one for _, one in read_records(path)[0]] == records


def test_values_that_are_not_json_are_refused_and_nothing_is_written(record, tmp_path):
    for value in (float("nan"), {1, 2}, np.float32(1)):
        with pytest.raises(InputError, match="not plain JSON"):
            append_record(tmp_path / RECORDS, dataclasses.replace(record, settings={"a": value}))
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
        ("schema", 3, "schema 3, this version reads 4"),
        ("schema", True, "schema True"),
    ],
)
def test_a_field_that_cannot_be_is_named(record, tmp_path, field, new, message):
    path = tmp_path / RECORDS
    append_record(path, record)
    value = json.loads(path.read_text())
    edit(value, field, new)
    path.write_text(json.dumps(value) + "\n")
    records, (fault,) = read_records(path)
    assert not records and fault.startswith(f"{path}:1: ") and message in fault


@pytest.mark.parametrize("text", ["", "[]", "3", "{"])
def test_a_damaged_line_is_named_and_the_rest_is_read(record, tmp_path, text):
    path = tmp_path / RECORDS
    append_record(path, record)
    path.write_bytes(path.read_bytes() + f"{text}\n".encode() + path.read_bytes())
    records, (fault,) = read_records(path)
    assert [where for where, _ in records] == [f"{path}:1", f"{path}:3"]
    assert f"{path}:2: " in fault


def test_score_holds_together():
    scores = score(np.array([0, 0, 2, 2]), np.array([0, 2, 2, -1]), ["a", "b", "c"])
    assert scores.per_class == (0.5, None, 0.5)
    assert scores.confusion == ((1, 0, 1, 0), (0, 0, 0, 0), (0, 0, 1, 1))
    assert sum(map(sum, scores.confusion)) == scores.clouds == 4
    assert scores.interval[0] < scores.accuracy < scores.interval[1]
    with pytest.raises(InputError, match="no cloud"):
        score(np.zeros(0, dtype=int), np.zeros(0, dtype=int), ["a"])
