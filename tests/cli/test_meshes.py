"""``qs3 meshes``: classes, sizes, hints, faults and a picture, from one folder."""

import trimesh
from PIL import Image


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
    assert "1 of 4, such as cup/a: tells no unit, looks to be in millimetres" in hint
    (fault,) = [line for line in lines if line.startswith("fault")]
    assert "d.off: cut short" in fault
    assert "not read: 1 .dwg" in caplog.text
    assert lines[-1] == str(sheet)
    with Image.open(sheet) as picture:
        assert picture.width > picture.height
