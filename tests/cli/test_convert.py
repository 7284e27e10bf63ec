"""``qs3 convert`` as a user types it."""

from pathlib import Path

import numpy as np
import pytest

from qs3.clouds.layouts import formats
from qs3.clouds.load import load_clouds


@pytest.fixture
def archive(tmp_path, rng):
    path = tmp_path / "clouds.npz"
    np.savez(
        path,
        points=rng.random((6, 9, 3)).astype(np.float32),
        label=np.array([0, 1, 2, 0, 1, 2]),
        class_names=np.array(["desk", "night_stand", "toilet"]),
        is_train=np.array([True, True, True, False, False, False]),
        name=np.array([f"thing {i}" for i in range(6)]),
    )
    return path


def test_one_command_gives_a_sound_data_set(typed, archive, tmp_path):
    done = typed("convert", archive, tmp_path / "a", "--to", "store", "--classes", "pointda10",
                 "--unmapped", "drop", "--num-points", 16)  # fmt: skip
    assert done.stdout == f"{tmp_path / 'a'}\n"
    assert done.stderr.splitlines() == [
        "4 clouds of 2 classes written as store. Next: qs3 train --source "
        f"{tmp_path / 'a'} --out RUN"
    ]
    typed("info", "--check", tmp_path / "a")
    assert load_clouds(tmp_path / "a", split="test", num_points=16).points.shape == (2, 16, 3)


def test_the_list_tells_every_layout(typed):
    rows = [line.split() for line in typed("convert", "--list").stdout.splitlines()]
    assert rows[0] == ["name", "read", "write", "layout"]
    assert [row[0] for row in rows[1:]] == list(formats())
    able = {row[0]: (row[1], row[2]) for row in rows[1:]}
    assert able["pointda10"] == ("yes", "no")
    assert able["ply"] == ("yes", "yes")


def test_from_split_and_cloud(typed, archive, tmp_path):
    typed("convert", archive, tmp_path / "a", "--to", "ply", "--split", "test")
    files = sorted(p.relative_to(tmp_path / "a").as_posix() for p in (tmp_path / "a").rglob("*.*"))
    assert files == [f"{name}/test/thing_{i}.ply"
                     for name, i in (("desk", 3), ("night_stand", 4), ("toilet", 5))]  # fmt: skip
    done = typed("convert", tmp_path / "a", tmp_path / "b", "--to", "ply", "--from", "folder")
    assert done.stderr.startswith("3 clouds of 3 classes written as ply. Next: qs3 train --source ")


def test_a_store_may_hold_a_copy_as_it_reads_its_own_shards(typed, archive, tmp_path):
    typed("convert", archive, tmp_path / "a", "--to", "store")
    typed("convert", tmp_path / "a", tmp_path / "a" / "ply", "--to", "ply")
    assert len(load_clouds(tmp_path / "a", num_points=None)) == 6


def test_clouds_without_labels_are_told_so(typed, tmp_path):
    (tmp_path / "flat").mkdir()
    (tmp_path / "flat" / "a.xyz").write_text("1 2 3\n")
    line = typed.refuses("convert", tmp_path / "flat", tmp_path / "flat" / "b", "--to", "ply")
    assert "flat, and would be read with it" in line
    done = typed("convert", tmp_path / "flat", tmp_path / "b", "--to", "ply")
    assert "1 clouds without labels written as ply. Next: qs3 train --method qbst" in done.stderr


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ((), ("name what to read", "--list")),
        (("ARCHIVE", "OUT", "--to", "obj"), ("'obj'", "modelnet-normal")),
        (("ARCHIVE", "OUT", "--to", "ply", "--from", "zip"), ("'zip'", "modelnet-normal")),
        (("ARCHIVE", "OUT", "--to", "ply", "--classes", "pointda10"), ("toilet", "--unmapped")),
        (("ARCHIVE", "OUT", "--to", "ply", "--cloud", "clean"), ("clouds.npz", "'clean'")),
        (("ARCHIVE", "ARCHIVE", "--to", "ply"), ("clouds.npz", "there already")),
        (("missing", "OUT", "--to", "ply"), ("missing", "no such file or folder")),
    ],
)  # fmt: skip
def test_each_fault_is_one_line_and_leaves_nothing(typed, archive, tmp_path, arguments, words):
    places = {"ARCHIVE": archive, "OUT": tmp_path / "out"}
    line = typed.refuses("convert", *[places.get(word, word) for word in arguments])
    assert all(word in line for word in words)
    assert [path.name for path in tmp_path.iterdir()] == ["clouds.npz"]


def test_the_page_of_layouts_names_them_all():
    page = (Path(__file__).parents[2] / "docs" / "formats.md").read_text(encoding="utf-8")
    for name in formats():
        assert f"`{name}`" in page, name
