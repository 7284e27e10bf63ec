import dataclasses
import hashlib
import json
import os
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from qs3.clouds.layouts.npz import read_npz
from qs3.clouds.layouts.store import read_ragged
from qs3.clouds.load import load_clouds
from qs3.errors import InputError
from qs3.store.generate import GenerateSettings
from qs3.store.info import check
from qs3.store.manifest import (
    MANIFEST,
    Manifest,
    mesh_sums,
    open_dataset,
    shard_name,
    write_manifest,
)
from qs3.store.shards import CloudRow, load_shard, put_shard, table_of

SETTINGS = GenerateSettings(num_points=16)


def put(folder: Path, index: int, rows: list[CloudRow]) -> Path:
    put_shard(folder, index, table_of(rows))
    return folder / shard_name(index)


def load(folder: Path, columns: list[str] | None = None):
    return load_shard(folder, 0, columns)


def rows(fake, count=6):
    classes = ("chair", "bed", "sofa")
    items = [fake.mesh(f"m{i}", classes[i % 3], ("train", "test")[i % 2]) for i in range(count)]
    return [fake.fake_row(item, 0, SETTINGS) for item in items]


def make(folder: Path, fake, shards=2) -> list:
    data = rows(fake)
    manifest = Manifest(
        settings={"views": 5, "sensor": {"rig": {"focal": 1500.0}}},
        class_names=SETTINGS.classes,
        rows=len(data),
        shards=shards,
        versions={"qs3": "0"},
    )
    write_manifest(folder, manifest)
    put(folder, 0, data[:4])
    if shards > 1:
        put(folder, 1, data[4:])
    return data


def test_what_is_written_comes_back(fake, tmp_path):
    dataset = make(tmp_path, fake)
    for cloud in ("points", "clean", "surface"):
        read = read_ragged(tmp_path, cloud)
        np.testing.assert_array_equal(read.clouds, [getattr(r, cloud) for r in dataset])
        assert read.labels.tolist() == [r.label for r in dataset]
        assert read.ids == tuple(r.id for r in dataset)


def test_shards_of_an_earlier_release_with_floors_are_read(fake, tmp_path):
    dataset = make(tmp_path, fake)
    checksum = read_ragged(tmp_path).checksum
    earlier = table_of(dataset[:4]).append_column(
        pa.field("floor", pa.float64()), pa.array([-0.5, None, 0.0, 1.0])
    )
    put_shard(tmp_path, 0, earlier)
    read = read_ragged(tmp_path)
    np.testing.assert_array_equal(read.clouds, [row.points for row in dataset])
    assert read.checksum == checksum
    assert "floor" not in load(tmp_path).column_names
    put_shard(tmp_path, 0, earlier.rename_columns([*earlier.column_names[:-1], "flor"]))
    with pytest.raises(InputError, match="other columns"):
        load(tmp_path)


def test_all_three_clouds_of_each_scan_come_as_clouds_of_their_own(fake, tmp_path):
    dataset = make(tmp_path, fake)
    clouds = read_ragged(tmp_path, "all")
    parts = {kind: read_ragged(tmp_path, kind) for kind in ("points", "clean", "surface")}
    expected = {
        f"{i}/{k}": c for k, p in parts.items() for i, c in zip(p.ids, p.clouds, strict=True)
    }
    assert set(clouds.ids) == set(expected)
    assert len(clouds.ids) == 3 * len(dataset)
    for name, cloud, label in zip(clouds.ids, clouds.clouds, clouds.labels, strict=True):
        np.testing.assert_array_equal(cloud, expected[name])
        assert label == {row.id: row.label for row in dataset}[name.rpartition("/")[0]]
    assert clouds.checksum not in {part.checksum for part in parts.values()}


def test_a_shard_reads_as_plain_parquet(fake, tmp_path):
    drawn = '{"light.ambient": 0.1, "neighbour": "m1"}'
    table = rows(fake)
    table[0] = dataclasses.replace(table[0], gross_share=float("nan"), split="", drawn=drawn)
    first = pq.read_table(put(tmp_path, 0, table)).slice(0, 1).to_pylist()[0]
    np.testing.assert_array_equal(np.reshape(first["points"], (-1, 3)), table[0].points)
    np.testing.assert_array_equal(first["view"], table[0].view)
    assert first["valid_fraction"] == 0.9
    assert first["gross_share"] is None
    assert (first["seed"], first["yaw"], first["drawn"]) == (table[0].seed, table[0].yaw, drawn)
    put(tmp_path, 0, [])
    assert load(tmp_path).num_rows == 0


def test_rows_that_tell_their_frame_have_the_splits_of_an_archive(fake, tmp_path):
    """What `qs3 extract nyuv2` writes is cut as the archive of the same objects is."""
    frames, strict = [9, 1, 4, 4, 7, 2], [True, True, False, True, True, True]
    dataset = make(tmp_path / "store", fake)
    names = np.array(["bed", "chair", "sofa"])
    for index, part in enumerate((slice(0, 4), slice(4, 6))):
        marks = zip(dataset[part], frames[part], strict[part], strict=True)
        facts = [(row, {"frame": frame, "strict": sure}) for row, frame, sure in marks]
        marked = [dataclasses.replace(row, drawn=json.dumps(fact)) for row, fact in facts]
        put(tmp_path / "store", index, marked)
    arrays = {"frame": np.array(frames), "strict": np.array(strict)}
    arrays |= {"label": np.zeros(6, int), "class_names": names}
    arrays |= {"points": np.zeros((6, 4, 3)), "name": np.array([row.id for row in dataset])}
    np.savez(tmp_path / "a.npz", **arrays)
    for split, wanted in (("strict-dev", "m1#0 m3#0 m5#0"), ("strict-check", "m0#0 m4#0")):
        read = read_ragged(tmp_path / "store", split=split)
        assert sorted(read.ids) == sorted(read_npz(tmp_path / "a.npz", split).ids)
        assert read.ids == tuple(wanted.split())
        assert read.checksum == read_ragged(tmp_path / "store").checksum
    assert len(read_ragged(tmp_path / "store", "all", "strict-dev").ids) == 9
    put(tmp_path / "store", 1, [dataclasses.replace(row, id="m1#0") for row in marked])
    assert read_ragged(tmp_path / "store", split="strict-dev").ids == ("m1#0", "m3#0", "m1#0")
    with pytest.raises(InputError, match="splits: strict-check, strict-dev, test, train"):
        read_ragged(tmp_path / "store", split="dev")
    damaged = json.dumps({"frame": [1, 2], "strict": True})
    put(tmp_path / "store", 1, [dataclasses.replace(row, drawn=damaged) for row in marked])
    with pytest.raises(InputError, match="no cloud of split 'strict-dev'; splits: test, train"):
        read_ragged(tmp_path / "store", split="strict-dev")


def test_an_unfinished_data_set_is_not_taken_for_a_whole_one(fake, tmp_path):
    make(tmp_path, fake)
    (tmp_path / shard_name(1)).unlink()
    with pytest.raises(InputError, match="unfinished, 1 of 2 shards"):
        read_ragged(tmp_path)


def test_the_checksum_follows_the_bytes(fake, tmp_path):
    dataset = make(tmp_path, fake)
    before = read_ragged(tmp_path).checksum
    assert load_clouds(tmp_path, num_points=8).checksum == before  # of what was read, not made
    assert read_ragged(tmp_path, "clean").checksum != before
    other = dataclasses.replace(dataset[5], label=1 - dataset[5].label % 2)
    put(tmp_path, 1, [dataset[4], other])
    assert read_ragged(tmp_path).checksum != before
    put(tmp_path, 1, dataset[4:][::-1])
    assert read_ragged(tmp_path).checksum != before


@pytest.mark.parametrize("damage", ["cut", "text", "empty", "bits"])
def test_a_damaged_shard_is_named(fake, tmp_path, damage):
    make(tmp_path, fake)
    path = tmp_path / shard_name(1)
    content = path.read_bytes()
    begin = content.find(b"\x28\xb5\x2f\xfd")  # the first compressed page
    path.write_bytes(
        {
            "cut": content[: len(content) // 2],
            "text": b"not parquet at all" * 10,
            "empty": b"",
            "bits": content[:begin] + bytes(400) + content[begin + 400 :],
        }[damage]
    )
    with pytest.raises(
        InputError, match=r"shard-00001\.parquet: (cannot be read as Parquet|the file is empty)"
    ) as caught:
        read_ragged(tmp_path)
    assert "\n" not in str(caught.value)


def test_points_that_are_not_finite_are_refused(fake, tmp_path):
    dataset = make(tmp_path, fake)
    bad = dataclasses.replace(dataset[0], points=np.full((16, 3), np.nan, dtype=np.float32))
    put(tmp_path, 0, [bad])
    with pytest.raises(InputError, match="points of 'm0#0'"):
        read_ragged(tmp_path)
    assert len(read_ragged(tmp_path, "clean").ids) == 3


def test_other_settings_are_refused_by_name(fake, tmp_path):
    make(tmp_path, fake)
    there = open_dataset(tmp_path)
    with pytest.warns(UserWarning, match="begun with qs3 0, continued with 9"):
        write_manifest(tmp_path, dataclasses.replace(there, versions={"qs3": "9"}))
    assert open_dataset(tmp_path) == there
    fewer = {"sensor": there.settings["sensor"]}
    with pytest.raises(InputError, match=r"views = 5, not None"):
        write_manifest(tmp_path, dataclasses.replace(there, settings=fewer))
    assert open_dataset(tmp_path) == there


@pytest.mark.parametrize("text", ["", "{", "[]", '{"schema": 1}', "\x80"])
def test_a_damaged_manifest_is_named(tmp_path, text):
    (tmp_path / MANIFEST).write_bytes(text.encode("latin-1"))
    with pytest.raises(InputError, match=r"dataset\.json"):
        open_dataset(tmp_path)


def test_a_folder_without_manifest_and_another_schema_are_refused(fake, tmp_path):
    with pytest.raises(InputError, match="not a qs3 data set"):
        open_dataset(tmp_path)
    make(tmp_path, fake)
    path = tmp_path / MANIFEST
    path.write_text(path.read_text().replace('"schema": 3', '"schema": 7'))
    with pytest.raises(InputError, match="schema 7"):
        open_dataset(tmp_path)


def test_check_lists_the_faults_of_a_data_set(fake, tmp_path):
    fake.run(fake.work(6), tmp_path)
    assert check(tmp_path, progress=False) == []
    shard = [fake.fake_row(item, 0, fake.SETTINGS) for item in fake.work(6)]
    bad = {"label": 0, "clean": shard[5].clean * np.nan, "view": shard[5].view[:3]}
    put(tmp_path, 1, [shard[3], dataclasses.replace(shard[5], **bad)])
    assert check(tmp_path, progress=False) == [
        "shard-00001.parquet: m5#0 has label 0 and class name 'chair'",
        "shard-00001.parquet: points of m5#0 has 16 points and 3 views",
        "shard-00001.parquet: clean of m5#0 is empty, not made of triples, or not finite",
        "shard-00001.parquet: m3#0 is there twice, also in shard-00000.parquet",
    ]
    put(tmp_path, 1, [shard[4]])
    assert check(tmp_path, progress=False) == ["6 rows planned, but 5 are there and 0 failed"]
    (tmp_path / shard_name(1)).write_bytes(b"PAR1")
    (damaged,) = check(tmp_path, progress=False)
    assert "shard-00001.parquet: cannot be read as Parquet" in damaged
    (tmp_path / shard_name(1)).unlink()
    assert "only 1 of 2 shards are there" in check(tmp_path, progress=False)[0]


def test_a_mesh_is_hashed_once_until_it_changes(tmp_path, monkeypatch):
    read = []

    def sha256(path):
        read.append(path)
        return hashlib.sha256(path.read_bytes()).hexdigest()

    monkeypatch.setattr("qs3.store.manifest.sha256", sha256)
    path = tmp_path / "a.stl"
    path.write_bytes(b"one")
    before = path.stat()
    assert mesh_sums({"a": path}) == mesh_sums({"a": path})
    assert read == [path]
    path.write_bytes(b"two")
    os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns + 1))
    assert mesh_sums({"a": path}) == {"a": hashlib.sha256(b"two").hexdigest()}
    for text in (b"new", b"old"):  # at once, of the same size and with the same date
        path.write_bytes(text)
        os.utime(path, ns=(before.st_atime_ns, before.st_mtime_ns))
        assert mesh_sums({"a": path}) == {"a": hashlib.sha256(text).hexdigest()}
    path.unlink()
    assert mesh_sums({"a": path}) == {}
