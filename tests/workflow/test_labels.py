"""Tables of labels: of any program, matched to files, and refused if unclear."""

import unicodedata
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from qs3.errors import InputError
from qs3.workflow.labels import read_labels

CLOUD = np.random.default_rng(0).normal(size=(60, 3))


@pytest.fixture
def table(tmp_path):
    """A table beside two clouds and a file of three."""
    for name in "ab":
        np.save(tmp_path / f"{name}.npy", CLOUD)
    np.save(tmp_path / "few.npy", CLOUD[:3])
    np.save(tmp_path / "copy.npy", CLOUD[::-1])
    np.savez(tmp_path / "set.npz", points=np.stack([CLOUD] * 3))
    return tmp_path / "labels.csv"


@pytest.mark.parametrize(
    "change",
    [
        lambda text: text.replace("file,class", "File , CLASS"),
        lambda text: text.replace(",", ";").replace("\n", "\r\n"),
        lambda text: text.replace(",", "\t"),
        lambda text: text.replace("\n", ",\n"),
        lambda text: text + "b.npy,\n\n,\n",
        lambda text: text + text.splitlines()[1] + "\n",
        lambda text: text.replace("a.npy", '"a.npy"'),
        lambda text: text.replace("a.npy,rod", ' "a.npy", "rod"'),
        lambda text: text.replace("a.npy", r".\a.npy"),
        lambda text: text.replace("file,", "file,score,").replace("a.npy,", "a.npy,0.5,"),
        lambda text: text.replace("file,", "file,suggested,").replace("a.npy,", "a.npy,block,"),
    ],
)
@pytest.mark.parametrize("codec", ["utf-8", "utf-8-sig", "utf-16"])
def test_tables_may_be_of_any_program(table, change, codec):
    table.write_bytes(change("file,class\na.npy,rod\n").encode(codec))
    read = read_labels(table, ["block", "rod"])
    assert read.ids == (str(table.parent / "a.npy"),)
    assert read.labels.tolist() == [1]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("file,class,class\na.npy,rod,block\n", "2 columns are called class"),
        ("name,class\na.npy,rod\n", "needs the columns file,class; its first line is 'name,class'"),
        ("file|class\na.npy|rod\n", r"columns file,class; its first line is 'file\|class'"),
        ('file,class\na.npy,rod\n"b.npy,block\n', "EOF inside string"),
        ("file,class\na.npy,rod,block\n", "Expected 2 fields in line 2, saw 3"),
        ("file;class\na.npy;rod\nb.npy,block\n", "b.npy,block: no such file"),
        ("number,file,class\n1,a.npy,rod\n2;b.npy;block\n", "2;b.npy;block: no such file"),
        ("file,class\na.npy,rod\na.npy,block\n", "a.npy: has two classes"),
        ("file,class\na.npy,rod\ncopy.npy,block\n", r"a\.npy and .*copy\.npy have the same points"),
        ("file,class\na.npy,rod\nfew.npy,rod\n", r"few\.npy has fewer than 12 distinct points"),
        ("file,class\na.npy,Rod\n", "unknown class 'Rod' .did you mean rod"),
        ("file,class\na.npy,\n", "no row has a class"),
        ("file,class\nc.npy,rod\n", r"no such file; looked for c\.npy, [^,]*$"),
        ("file,class\nset.npz,rod\n", r"set\.npz: holds 3 clouds, not one"),
    ],
)
def test_tables_that_are_unclear_are_refused(table, text, message):
    table.write_text(text)
    with pytest.raises(InputError, match=message):
        read_labels(table, ["block", "rod"])


def test_messages_name_a_file_as_the_user_did(table, monkeypatch):
    table.write_text("file,class\nset.npz,rod\n")
    monkeypatch.chdir(table.parent)
    with pytest.raises(InputError, match=r"^set\.npz: holds 3 clouds"):
        read_labels(Path("labels.csv"), ["rod"])


def test_a_name_of_two_files_is_refused(tmp_path):
    for name in ("a\u200eb", r"a\u200eb"):
        np.save(tmp_path / f"{name}.npy", CLOUD)
    (tmp_path / "labels.csv").write_text("file,class\na\\u200eb.npy,rod\n")
    with pytest.raises(InputError, match="is the name of two files"):
        read_labels(tmp_path / "labels.csv", ["rod"])


def test_a_cloud_of_a_data_set_has_no_file_to_label(table):
    table.write_text("file,class\n0,rod\n")
    with pytest.raises(InputError, match=r"no such file; .*qs3 convert .*set\.npz FOLDER --to ply"):
        read_labels(table, ["rod"], table.parent / "set.npz")
    (table.parent / "files").mkdir()
    for _ in range(2):  # an empty folder, and one with a scan
        with pytest.raises(InputError, match=r"no such file; looked for [^;]*$"):
            read_labels(table, ["rod"], table.parent / "files")
        np.save(table.parent / "files" / "a.npy", CLOUD)


def test_a_name_of_files_in_two_places_is_refused(tmp_path, monkeypatch):
    """A page names scans from their folder, and its table may be saved beside other scans."""
    for place in ("monday", "tuesday"):
        (tmp_path / place).mkdir()
        np.save(tmp_path / place / "a.npy", CLOUD)
    labels = tmp_path / "tuesday" / "labels.csv"
    labels.write_text("file,class\na.npy,rod\n")
    with pytest.raises(InputError, match=r"a\.npy is the name of two files: .*tuesday.*monday"):
        read_labels(labels, ["rod"], tmp_path / "monday")
    monkeypatch.chdir(labels.parent)
    with pytest.raises(InputError, match=r"two files: a\.npy and .*monday"):
        read_labels(Path("labels.csv"), ["rod"], Path("..", "monday"))
    assert len(read_labels(Path("labels.csv"), ["rod"], Path("..", "tuesday"))) == 1
    Path("a.npy").unlink()
    Path("a.npy").symlink_to(Path("..", "monday", "a.npy"))
    assert len(read_labels(Path("labels.csv"), ["rod"], Path("..", "monday"))) == 1


@pytest.mark.parametrize(("disk", "table"), [("NFC", "NFD"), ("NFD", "NFC")])
def test_labels_find_files_and_classes_in_either_form_of_unicode(tmp_path, disk, table):
    on_disk, typed_in = (partial(unicodedata.normalize, form) for form in (disk, table))
    name, kind = "Gr\u00f6\u00dfe/\u00e9l\u00e9ment.npy", "Sch\u00e4ft"
    file = tmp_path / on_disk(name)
    file.parent.mkdir()
    np.save(file, CLOUD)
    labels = tmp_path / "labels.csv"
    labels.write_text(f"file,class\n{typed_in(name)},{typed_in(kind)}\n", "utf-8")
    read = read_labels(labels, ["rod", on_disk(kind)])
    assert read.ids == (str(file),)
    assert read.labels.tolist() == [1]
    both = tmp_path / typed_in(name)  # a file of exactly that name comes first
    both.parent.mkdir()
    np.save(both, CLOUD)
    assert read_labels(labels, ["rod", on_disk(kind)]).ids == (str(both),)
