"""``qs3 meshes``: classes, sizes, hints, faults and a picture, from one folder."""

import pytest
import trimesh
from PIL import Image


@pytest.fixture
def parts(tmp_path):
    """Makes cubes of a length at places below a folder whose name a shell takes apart."""
    root = tmp_path / "my parts"

    def make(**lengths):
        for name, length in lengths.items():
            path = root / f"{name.replace('__', '/')}.stl"
            path.parent.mkdir(parents=True, exist_ok=True)
            trimesh.creation.box((length, length, length / 2)).export(path)
        return root

    return make


def test_a_folder_is_shown_with_its_sizes_hints_and_faults(tmp_path, typed, caplog):
    for name, length in (("cup/a.stl", 90.0), ("cup/b.obj", 0.12), ("lid/c.ply", 0.1)):
        (tmp_path / name).parent.mkdir(exist_ok=True)
        trimesh.creation.box((length, length, length / 2)).export(tmp_path / name)
    (tmp_path / "lid" / "d.off").write_text("OFF\n3 1 0\n")
    (tmp_path / "lid" / "e.dwg").touch()
    sheet = tmp_path / "sheet.png"
    done = typed("meshes", tmp_path, "--out", sheet, code=1)
    lines = done.stdout.splitlines()
    assert lines[1].split() == ["cup", "2", "0.09", "to", "0.12", "1", "0"]
    assert lines[2].split() == ["lid", "2", "0.1", "to", "0.1", "0", "1"]
    (hint,) = [line for line in lines if line.startswith("hint")]
    assert "1 of 4, such as cup/a: names no unit, looks to be in millimetres" in hint
    (fault,) = [line for line in lines if line.startswith("fault")]
    assert "d.off: declares 3 vertices" in fault
    assert "not read: 1 .dwg" in caplog.text
    assert lines[-1] == str(sheet)
    with Image.open(sheet) as picture:
        assert picture.width > picture.height


def test_symmetries_of_a_few_meshes_are_shown(tmp_path, typed, monkeypatch):
    """Those that pictures and poses show alike; of many meshes they would take long."""
    box = trimesh.creation.box
    foot = box((0.02, 0.008, 0.02)).apply_translation((-0.02, 0.011, 0.012))
    for name, mesh in (
        ("block", box((0.1, 0.07, 0.04))),
        ("box", box((0.1, 0.06, 0.03))),
        ("pin", trimesh.creation.cylinder(0.01, 0.07)),
        ("marble", trimesh.creation.icosphere(4, 0.02)),
        ("lever", trimesh.util.concatenate([box((0.06, 0.03, 0.005)), foot])),
        ("sheet", trimesh.Trimesh([[0, 0, 0], [0.06, 0, 0], [0, 0.05, 0]], [[0, 1, 2]])),
    ):
        mesh.export(tmp_path / f"{name}.stl")
    words = ("meshes", tmp_path, "--out", tmp_path / "sheet.png", "--units", "m")
    lines = [x for x in typed(*words).stdout.splitlines() if x.startswith("symmetry")]
    assert sorted(lines) == [
        "symmetry of block, box: 4 turns",
        "symmetry of marble: any turn",
        "symmetry of pin: any turn about an axis, and its reverse",
    ]
    monkeypatch.setattr("qs3.cli.meshes._COMPARED", 5)
    assert "symmetry" not in typed(*words).stdout


def test_each_file_beside_class_folders_is_a_class_and_is_named(parts, tmp_path, typed, caplog):
    done = typed("meshes", parts(a=1.0, cup__b=1.0), "--out", tmp_path / "sheet.png")
    assert "each file beside the folders is a class, named by its stem: a.stl" in caplog.text
    assert [line.split()[0] for line in done.stdout.splitlines()[1:3]] == ["a", "cup"]
    assert "qs3 generate" in done.stderr


def test_nothing_follows_meshes_that_are_all_faulty(tmp_path, typed):
    words = ("meshes", tmp_path, "--out", tmp_path / "sheet.png")
    (tmp_path / "a.off").write_text("OFF\n3 1 0\n")
    assert "Next:" not in typed(*words, code=1).stderr
    trimesh.creation.box((1, 1, 1)).export(tmp_path / "b.off")
    assert "Next:" in typed(*words, code=1).stderr


@pytest.mark.parametrize("name", ["sheet.jpg", "sheet"])
def test_a_sheet_that_is_no_png_is_refused(parts, tmp_path, typed, name):
    line = typed.refuses("meshes", parts(cup__a=1.0), "--out", tmp_path / name)
    assert "ends in .png" in line
    assert not (tmp_path / name).exists()


def test_a_sheet_names_each_mesh_and_draws_faults_in_red(parts, tmp_path, typed, monkeypatch):
    from qs3.report import sheet

    drawn = []
    plain = sheet.contact_sheet
    monkeypatch.setattr(
        sheet, "contact_sheet", lambda *arguments: drawn.append(arguments) or plain(*arguments)
    )
    names = {"cup__a": 1.0, "cup__b": 2.0, "cup__c": 0.04, "lid__x__model": 3.0, "lid__y__model": 4}
    typed("meshes", parts(**names), "--out", tmp_path / "sheet.png")
    found = {(tile.class_name, tile.name, tile.is_faulty) for tile in drawn[0][0]}
    cups = {("cup", "a", False), ("cup", "b", False), ("cup", "c", True)}
    assert found == cups | {("lid", "x", False), ("lid", "y", False)}


def test_a_shaded_mesh_has_the_size_of_its_scale():
    from qs3.report.sheet import shaded

    sphere = trimesh.creation.icosphere(radius=25.0)
    shown = (shaded(sphere, 100.0) < 1).any(axis=-1)
    assert shown.any(axis=0).sum() == pytest.approx(80, abs=2)  # half of the picture
    assert shown.any(axis=1).sum() == pytest.approx(80, abs=2)
