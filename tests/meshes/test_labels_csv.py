"""Classes and splits of meshes from a CSV."""

import itertools
import unicodedata
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from qs3.errors import InputError
from qs3.meshes import MeshItem, collect

from ..clouds.hostile import refused


def listed(items: list[MeshItem]) -> list[tuple[str, str, str]]:
    return [(item.id, item.class_name, item.split) for item in items]


def put(path: Path, text: str) -> Path:
    path.write_bytes(text.encode())
    return path


def test_objaverse_layout(tree, tmp_path: Path) -> None:
    root = tree("glbs/000-001/ab12.glb", "glbs/000-002/cd34.glb", "glbs/000-002/ef.56.glb", "x.off")
    labels = put(
        tmp_path / "lvis.csv",
        "uid,name,category,score\ncd34,my mug,mug,1\nab12,seat,armchair,2\nef.56,b,Floor Lamp,3\n",
    )
    assert listed(collect(root, labels=labels)) == [
        ("glbs/000-001/ab12", "armchair", ""),
        ("glbs/000-002/cd34", "mug", ""),
        ("glbs/000-002/ef.56", "Floor Lamp", ""),
    ]
    assert listed(collect(root, labels=str(labels), classes="pointda10")) == [
        ("glbs/000-001/ab12", "chair", ""),
        ("glbs/000-002/ef.56", "lamp", ""),
    ]
    assert len(collect(root, labels=labels, classes=["mug"])) == 1
    with pytest.raises(InputError, match="no class 'cup'; it has Floor Lamp, armchair, mug"):
        collect(root, labels=labels, classes=["cup"])


@pytest.mark.parametrize("codec", ["utf-8", "utf-8-sig", "utf-16"])
@pytest.mark.parametrize("apart", [",", ";", "\t"])
def test_any_separator_and_unicode_of_a_spreadsheet(tree, tmp_path, apart, codec) -> None:
    rows = [("File", "Class"), ("a.off", "Mütze")]
    labels = tmp_path / "l.csv"
    labels.write_text("\r\n".join(apart.join(row) for row in rows), encoding=codec)
    assert listed(collect(tree("a.off"), labels=labels)) == [("a", "Mütze", "")]


@pytest.mark.parametrize(("disk", "table"), [("NFC", "NFD"), ("NFD", "NFC")])
def test_files_and_classes_are_found_in_either_form_of_unicode(tree, tmp_path, disk, table) -> None:
    on_disk, typed = (partial(unicodedata.normalize, form) for form in (disk, table))
    text = f"file,class\n{typed('Größe')}.off,{typed('Mütze')}\n"
    items = collect(tree(f"{on_disk('Größe')}.off"), labels=put(tmp_path / "l.csv", text))
    assert [item.class_name for item in items] == [unicodedata.normalize("NFC", "Mütze")]
    assert collect(tree(), labels=tmp_path / "l.csv", classes=[on_disk("Mütze")]) == items


def test_every_way_to_name_a_mesh(tree, tmp_path: Path) -> None:
    names = ["sub/a.off", "./sub//a.off", "sub\\a.off", "sub/a", "a.off", "a"]
    heads = [(file, "class") for file in ("file", " Path", "UID", "id", "name")]
    heads += [("file", kind) for kind in ("label", "category", "class_name")]
    for (file, kind), name in itertools.product(heads, names):
        labels = put(tmp_path / "l.csv", f"split,{kind},{file}\n test ,chair,{name}\n\n")
        assert listed(collect(tree("sub/a.off"), labels=labels)) == [("sub/a", "chair", "test")]


@pytest.mark.parametrize(
    "text",
    [
        "\ufefffile;class\r\na.off;chair\r\n",
        "file\tclass\ra.off\tchair",
        'file,class\n"a.off","chair"\n',
        "file,class,label,split\na.off,chair,7,\n",
    ],
)
def test_spreadsheets_write_csv_in_many_ways(tree, tmp_path: Path, text: str) -> None:
    labels = put(tmp_path / "l.csv", text)
    assert listed(collect(tree("a.off", "b.off"), labels=labels)) == [("a", "chair", "")]


def test_the_split_is_the_tables_and_else_the_folders(tree, tmp_path: Path) -> None:
    root = tree("x/train/a.off", "x/train/b.off")
    labels = put(tmp_path / "l.csv", "file,class,split\na,chair,test\nb,chair,\n")
    assert [item.split for item in collect(root, labels=labels)] == ["test", "train"]


def test_an_id_does_not_depend_on_which_rows_there_are(tree, tmp_path: Path) -> None:
    root = tree("a.off", "a.obj", "b.off")
    few = put(tmp_path / "few.csv", "file,class\na.off,chair\n")
    more = put(tmp_path / "more.csv", "file,class\na.off,chair\na.obj,chair\nb,bed\n")
    assert collect(root, labels=few) == collect(root, labels=more)[1:2]
    assert collect(root, labels=few)[0].id == "a.off"


def test_convention_shapenet_is_y_up_with_labels_too(tree, tmp_path: Path) -> None:
    root = tree("03001627/a/models/model_normalized.obj", "mine/b.obj")
    rows = "file,class\n03001627/a/models/model_normalized,seat\nb,bed\n"
    items = collect(root, labels=put(tmp_path / "l.csv", rows))
    sides = [np.ptp(item.load().vertices, axis=0).tolist() for item in items]
    assert sides == [[1, 0, 3], [1, 3, 0]]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "the file is empty"),
        ("file,kind\na,chair\n", r"line 1: no column class_name .*; it has 'file', 'kind'$"),
        ("file,class\n", "no row after the headings"),
        ("file,class\na,chair\nz,chair\n", "line 3: 'z' is no mesh below"),
        ("file,class\ntwin,chair\n", "line 2: 'twin' is 2 files, such as d/twin.off and twin.obj"),
        ("file,class\n../out.off,chair\n", r"line 2: '../out.off' is no mesh below"),
        ("file,class\na,chair\na.off,chair\n", "line 3: 'a.off' has a row already"),
        ("file,class\na, \n", "line 2: 'a' has an empty class"),
        ('file,class\na,"two\nlines"\n', r"line 2: 'a' has an odd class 'two\\nlines' or split"),
        ("file,class\na,chair,sofa\n", "Expected 2 fields in line 2, saw 3"),
        ('file,class\na,"chair\n', "cannot be read as CSV"),
        ("file,unit\na,inch\n", "line 2: unit 'inch' is unknown; choose m, cm, mm, in"),
        ("file,up\na,x\n", "line 2: up 'x' is unknown; choose z, y"),
        ("file,class,units\na,b,mm\n", "line 1: no column 'units' is read; call it unit or up"),
    ],
)
def test_faulty_tables_are_named_in_one_line(tree, tmp_path: Path, text: str, message: str) -> None:
    root = tree("a.off", "twin.obj", "d/twin.off", "notes.txt")
    labels = put(tmp_path / "l.csv", text)
    with refused(f"^{labels}.*(?:{message})"):
        collect(root, labels=labels)
