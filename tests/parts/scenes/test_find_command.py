"""``qs3 find``: frames of all kinds in, tables of poses out."""

import csv
import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
import trimesh
from scipy.spatial import ConvexHull

from qs3.errors import TOLD, InputError
from qs3.evaluation.poses import adds
from qs3.frames.camera_files import read_intrinsics
from qs3.frames.cameras import DepthFrame
from qs3.frames.folder import capture
from qs3.objects.cut import lift
from qs3.parts import find
from qs3.parts.scenes import find_files
from qs3.parts.scenes.find_files import find_in_frames, read_base
from qs3.parts.scenes.frames import list_frames

from ...objects.depth_scene import write_png
from ...stores import once
from .tables import INTRINSICS, MATRIX, PARTS, Shot, lain, shoot


@pytest.fixture(scope="module", autouse=True)
def found_once():
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("qs3.parts.scenes.find_files.find", once(find, kept={}))
        yield


@pytest.fixture(scope="module")
def shot() -> Shot:
    return shoot(lain("bracket", -0.06, 0.0, 30), lain("pin", 0.06, 0.0))


@pytest.fixture(scope="module")
def cad(tmp_path_factory) -> Path:
    folder = tmp_path_factory.mktemp("cad")
    for name, mesh in PARTS.items():
        mesh.copy().apply_scale(1000).export(folder / f"{name}.stl")
    return folder


def steps(depth: np.ndarray) -> np.ndarray:
    return np.rint(depth * 1e4).astype(np.uint16)


def captured(folder: Path, shot: Shot) -> Path:
    """Write a folder as ``qs3 capture`` does."""
    write_png(folder / "depth" / "000004.png", steps(shot.depth))
    names = dict(zip(("fx", "fy", "cx", "cy"), map(float, INTRINSICS.split(",")), strict=True))
    camera = names | {"width": 320, "height": 240, "depth_unit": 1e-4}
    (folder / "intrinsics.json").write_text(json.dumps(camera))
    return folder


def bop_scene(folder: Path, shot: Shot) -> Path:
    write_png(folder / "000002" / "depth" / "000004.png", steps(shot.depth))
    camera = {"4": {"cam_K": MATRIX.ravel().tolist(), "depth_scale": 0.1}}
    (folder / "000002" / "scene_camera.json").write_text(json.dumps(camera))
    return folder


def cloud(folder: Path, shot: Shot) -> Path:
    np.save(folder / "cloud.npy", lift(shot.depth, shot.depth > 0, read_intrinsics(INTRINSICS)))
    return folder / "cloud.npy"


@pytest.mark.parametrize("kind", [captured, bop_scene, cloud])
def test_frames_of_all_kinds_give_poses(tmp_path, typed, cad, shot, kind) -> None:
    out = tmp_path / "poses.json"
    done = typed("find", cad, kind(tmp_path, shot), "--units", "mm", "--json", out)
    (frame,) = json.loads(out.read_text())
    found = {part["class"]: np.array(part["pose"]) for part in frame["parts"]}
    assert set(found) == set(shot.names)
    for name, pose in zip(shot.names, shot.poses, strict=True):
        assert adds(found[name], pose, np.asarray(PARTS[name].vertices)) < 0.003
        assert name in done.stdout


def test_another_file_than_a_depth_picture_is_no_cloud_beside_a_camera(tmp_path) -> None:
    (tmp_path / "depth.pgm").touch()
    with pytest.raises(InputError, match=r"depth\.pgm: is no depth picture \(\.png"):
        list_frames(tmp_path / "depth.pgm", INTRINSICS)


def test_the_number_of_a_scene_is_not_that_of_its_camera(tmp_path, shot) -> None:
    scene = bop_scene(tmp_path, shot) / "000002"
    (scene / "scene_camera.json").rename(scene / "scene_camera_cam1.json")
    (scene / "depth").rename(scene / "depth_cam1")
    (frame,) = list_frames(tmp_path)
    assert (frame.name, frame.scene_id, frame.im_id) == ("000002_cam1/000004", 2, 4)


def test_pictures_of_a_captured_folder_have_its_camera(tmp_path, typed, cad, shot) -> None:
    captured(tmp_path / "png", shot)
    camera = read_intrinsics(INTRINSICS)
    capture((DepthFrame(shot.depth, camera, name, None) for name in "0"), tmp_path / "npy")
    for source in ("png/depth/000004.png", "png/depth", "npy/depth/000000.npy"):
        words = ("find", cad, tmp_path / source, "--units", "mm", "--json", "-")
        (frame,) = json.loads(typed(*words).stdout)
        assert len(frame["parts"]) == 2


def test_a_library_is_kept_and_taken(tmp_path, typed, cad, shot, monkeypatch) -> None:
    folder, file = captured(tmp_path, shot), tmp_path / "cad.safetensors"
    words = ("--json", "-", "--library", file)
    first = typed("find", cad, folder, "--units", "mm", *words).stdout
    monkeypatch.setattr("qs3.parts.library.view_of", None)  # no CAD is looked at again
    seconds = re.compile('"seconds": .*')
    for again in (
        typed("find", cad, folder, "--units", "mm", *words),
        typed("find", file, folder, "--json", "-"),
    ):
        assert seconds.sub("", again.stdout) == seconds.sub("", first)
    assert "is a library already" in typed.refuses("find", file, folder, *words)


@pytest.fixture
def block(tmp_path) -> tuple[Path, Path]:
    """A folder with one CAD file, and a frame of that part."""
    (tmp_path / "blocks").mkdir()
    PARTS["block"].copy().apply_scale(1000).export(tmp_path / "blocks" / "block.stl")
    return tmp_path / "blocks", captured(tmp_path, shoot(lain("block", 0.0, 0.0)))


def test_a_wrong_unit_of_the_cad_is_asked_about(tmp_path, typed, block) -> None:
    for units, is_asked in (("in", True), ("mm", False)):
        done = typed("find", *block, "--units", units)
        assert ("is its unit right" in done.stderr) == is_asked
    far = typed("find", *block, "--units", "m", code=2).stderr
    assert "block.stl: object_size file: the mesh is 70 m" in far
    kept = tmp_path / "cad.safetensors"
    typed("find", *block, "--units", "in", "--library", kept)
    assert "make it with --units" in typed("find", kept, block[1]).stderr  # it refuses the option


def test_a_wrong_unit_of_depth_is_asked_about(tmp_path, typed, cad, shot, block) -> None:
    """Pixels so far apart are in clusters still, and parts need pixels of their own."""
    some = cad, captured(tmp_path / "some", shot)  # five times too far, a part is taken for another
    for frames, scale in ((some, 5e-4), (block, 1e-3)):  # 1e-4 is right
        done = typed("find", *frames, "--units", "mm", "--depth-scale", scale)
        assert "and that of depth (--depth-scale)?" in done.stderr
        assert "unexplained" in done.stdout
        assert ("score" in done.stdout) == (frames is some)


def test_units_are_asked_about_once_and_after_the_first_frame(
    tmp_path, typed, block, monkeypatch
) -> None:
    questions, before, each = [], [], find_in_frames

    def watched(*words):
        for answer in each(*words):
            before.append(len(questions))
            yield answer

    first = block[1] / "depth" / "000004.png"
    shutil.copy(first, first.with_name("000005.png"))
    monkeypatch.setattr("qs3.parts.scenes.find_files.find_in_frames", watched)
    monkeypatch.setattr("qs3.cli.find.notify", lambda *lines: questions.append(lines))
    typed("find", *block, "--units", "in")
    assert before == [0, 1]
    assert len(questions) == 1


def test_one_part_under_two_classes_is_named(tmp_path, typed, cad, shot, caplog) -> None:
    folder = shutil.copytree(cad, tmp_path / "cad")
    words = ("find", folder, captured(tmp_path, shot), "--units", "mm")
    for twin in ("stud.obj", "stud.stl"):
        trimesh.load(folder / "pin.stl").export(folder / twin)
        for _ in range(2):  # looked at, and kept
            TOLD.clear()
            caplog.clear()
            typed(*words, "--library", tmp_path / f"{twin}.safetensors")
            assert "pin and stud have the same shape, and no scan can tell pin from" in caplog.text
        (folder / twin).unlink()


def bop_results(path: Path) -> list[dict]:
    """Read results as the BOP toolkit documents them: seven cells, R by rows, t in mm."""
    found = []
    for number, line in enumerate(path.read_text().splitlines()):
        if number == 0 and line == "scene_id,im_id,obj_id,score,R,t,time":
            continue
        cells = line.split(",")
        assert len(cells) == 7
        turn = np.array(list(map(float, cells[4].split())), float).reshape(3, 3)
        shift = np.array(list(map(float, cells[5].split())), float).reshape(3, 1)
        ids = dict(zip(("scene_id", "im_id", "obj_id"), map(int, cells[:3]), strict=True))
        found.append(
            ids | {"score": float(cells[3]), "R": turn, "t": shift, "time": float(cells[6])}
        )
    return found


def test_tables_agree_with_each_other(tmp_path, typed, cad, shot) -> None:
    base = np.array([[0.0, -1, 0, 0.5], [1, 0, 0, -0.2], [0, 0, 1, 0.1], [0, 0, 0, 1]])
    np.savetxt(tmp_path / "T.txt", base)
    words = ("find", cad, bop_scene(tmp_path / "bop", shot), "--units", "mm", "--base",
             tmp_path / "T.txt", "--json", tmp_path / "p.json", "--csv", tmp_path / "p.csv",
             "--bop", tmp_path / "results.csv")  # fmt: skip
    typed(*words)
    typed(*words, "--pictures", tmp_path / "pictures")  # answers replace answers
    (frame,) = json.loads((tmp_path / "p.json").read_text())
    with (tmp_path / "p.csv").open(newline="") as file:
        rows = [row for row in csv.DictReader(file) if row["cad"]]
    results = bop_results(tmp_path / "results.csv")
    numbers = {"block": 1, "bracket": 2, "pin": 3}
    assert len(rows) == len(results) == len(frame["parts"]) == 2
    for part, row, result in zip(frame["parts"], rows, results, strict=True):
        pose, from_base = np.array(part["pose"]), np.array(part["base_from_part"])
        np.testing.assert_allclose(from_base, base @ pose, atol=1e-12)
        shift = [float(row[name]) for name in "xyz"]
        np.testing.assert_allclose(shift, from_base[:3, 3], atol=1e-7)
        turn = [float(row[f"r{i}{j}"]) for i in (1, 2, 3) for j in (1, 2, 3)]
        np.testing.assert_allclose(turn, from_base[:3, :3].ravel(), atol=1e-7)
        np.testing.assert_allclose(result["R"], pose[:3, :3], atol=1e-7)
        np.testing.assert_allclose(result["t"][:, 0], 1000 * pose[:3, 3], atol=1e-4)
        assert (result["scene_id"], result["im_id"]) == (2, 4)
        assert result["obj_id"] == numbers[part["class"]]
    assert (tmp_path / "pictures" / "000002_000004.png").stat().st_size > 5000


def test_masks_of_coco_divide_what_touches(tmp_path, typed, cad) -> None:
    shot = shoot(lain("block", 0.0, 0.0), lain("block", 0.0, 0.046, 4))
    folder = captured(tmp_path / "shots", shot)
    corners = []
    for pose in shot.poses[:1]:
        seen = PARTS["block"].vertices @ pose[:3, :3].T + pose[:3, 3]
        hull = trimesh.PointCloud((seen @ MATRIX.T)[:, :2] / seen[:, 2:]).vertices
        corners.append(hull[ConvexHull(hull).vertices].ravel().tolist())
    rows = [{"image_id": 4, "segmentation": [polygon]} for polygon in corners]
    (tmp_path / "masks.json").write_text(json.dumps(rows))
    words = ("find", cad, folder, "--units", "mm", "--json", "-", "--masks")
    (frame,) = json.loads(typed(*words, tmp_path / "masks.json").stdout)
    (part,) = frame["parts"]
    assert adds(np.array(part["pose"]), shot.poses[0], np.asarray(PARTS["block"].vertices)) < 0.004
    other = [{"image_id": 4, "segmentation": {"size": [24, 32], "counts": [768]}}]
    (tmp_path / "other.json").write_text(json.dumps(other))
    done = typed(*words, tmp_path / "other.json", code=2)
    assert "other.json: has a mask of 32×24 pixels, the depth image has 320×240" in done.stderr


def test_no_masks_and_no_numbers_are_of_two_frames(tmp_path, typed, cad, shot) -> None:
    folders = [captured(tmp_path / name, shot) for name in ("a", "b")]
    (tmp_path / "masks").mkdir()
    words = ("find", cad, *folders, "--units", "mm")
    table = tmp_path / "p.csv"
    lines = typed(*words, "--csv", table, "--json", tmp_path / "p.json").stdout.splitlines()
    assert {line.split("\t")[0] for line in lines} == {
        f"{folder}/depth/000004.png" for folder in folders
    }
    with table.open(newline="") as file:
        found = [row["file"] for row in csv.DictReader(file)]
    frames = json.loads((tmp_path / "p.json").read_text())
    rows = [frame["file"] for frame in frames for _ in frame["parts"] + frame["unexplained"]]
    assert found == rows
    assert len({*found}) == 2
    advice = "search them one by one"
    assert "--bop" in (line := typed.refuses(*words, "--bop", tmp_path / "r.csv"))
    assert "are both image 4 of scene 0" in line
    assert advice in typed.refuses(*words, "--masks", tmp_path / "masks")
    rows = [{"image_id": 4, "segmentation": [[0, 0, 9, 0, 9, 9]]}]
    (tmp_path / "m.json").write_text(json.dumps(rows))
    assert advice in typed.refuses(*words, "--masks", tmp_path / "m.json")


def test_masks_of_no_frame_are_refused_or_reported(tmp_path, typed, cad, shot, caplog) -> None:
    words = ("find", cad, captured(tmp_path / "a", shot), "--units", "mm", "--masks")
    (tmp_path / "masks").mkdir()
    (tmp_path / "masks" / "000004.jpg").touch()
    line = typed.refuses(*words, tmp_path / "masks")
    assert "masks: no mask has the name of a frame; masks are .png" in line
    rows = [{"image_id": 5, "segmentation": [[0, 0, 9, 0, 9, 9]]}]
    (tmp_path / "m.json").write_text(json.dumps(rows))
    fault = "m.json: image 5 has masks and is no frame"
    assert fault in typed.refuses(*words, tmp_path / "m.json")
    (tmp_path / "m.json").write_text(json.dumps([*rows, {**rows[0], "image_id": 4}]))
    typed(*words, tmp_path / "m.json")
    assert fault in caplog.text


def test_bad_frames_are_reported_last_and_the_others_done(tmp_path, typed, cad, shot) -> None:
    folder = captured(tmp_path / "shots", shot)
    write_png(folder / "depth" / "000005.png", np.zeros((240, 320), np.uint16))
    write_png(folder / "depth" / "000006.png", np.full((24, 32), 5000, np.uint16))
    out = tmp_path / "poses.json"
    done = typed("find", cad, folder, "--units", "mm", "--json", out, code=2)
    assert "000005.png" in done.stderr
    assert "000006.png" in done.stderr
    assert "(2 of 3 frames)" in done.stderr
    frames = json.loads(out.read_text())
    assert [len(frame.get("parts", [])) for frame in frames] == [2, 0, 0]
    assert all("000005" in frames[1][name] for name in ("fault", "file"))


def test_frames_that_are_finished_before_ctrl_c_stay(tmp_path, typed, cad, shot, monkeypatch):
    folder, calls, search = captured(tmp_path / "shots", shot), [], find_files.find
    write_png(folder / "depth" / "000009.png", steps(shot.depth))

    def stopped(*words):
        calls.append(words)
        if len(calls) == 2:
            raise KeyboardInterrupt
        return search(*words)

    monkeypatch.setattr(find_files, "find", stopped)
    out = tmp_path / "parts.csv"
    done = typed("find", cad, folder, "--units", "mm", "--csv", out, code=130)
    assert len(out.read_text().splitlines()) == 1 + len(done.stdout.splitlines()) == 3
    assert f"{out}: has what was answered before" in done.stderr
    assert done.stderr.endswith("qs3: stopped; the same command begins anew\n")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--far", "-1"], "far -1.0 must be above 0"),
        (["--gravity", "0", "0", "0"], "gravity (0.0, 0.0, 0.0): must be a direction"),
        (["--min-points", "0"], "min_points 0 must be at least 1"),
    ],
)
def test_what_fits_no_frame_ends_at_the_first(
    tmp_path, monkeypatch, typed, cad, shot, words, message
) -> None:
    monkeypatch.chdir(tmp_path)
    captured(tmp_path / "shots", shot)
    line = typed.refuses("find", cad, "shots", "--units", "mm", *words, "--csv", "out.csv")
    assert message in line
    assert "frames)" not in line
    assert not Path("out.csv").exists()


@pytest.mark.parametrize("codec", ["utf-8", "utf-16"])
@pytest.mark.parametrize("form", ["np.savetxt with a header", "NumPy's print", "semicolons"])
def test_a_pose_file_may_have_comments_and_brackets(tmp_path, form, codec) -> None:
    pose = np.array([[0.0, -1, 0, 0.5], [1, 0, 0, -0.25], [0, 0, 1, 0.125], [0, 0, 0, 1]])
    text = str(pose) if "print" in form else "\n".join(";".join(map(str, row)) for row in pose)
    (tmp_path / "T.txt").write_text(text, encoding=codec)
    if "header" in form:
        np.savetxt(tmp_path / "T.txt", pose, header="base from camera 1", encoding=codec)
    np.testing.assert_array_equal(read_base(tmp_path / "T.txt"), pose)


@pytest.mark.parametrize("shift", ["nan", "-inf", "300"])
def test_a_pose_file_without_a_shift_in_metres_is_refused(tmp_path, shift) -> None:
    (tmp_path / "T.txt").write_text(f"1 0 0 0.5\n0 1 0 0.2\n0 0 1 {shift}\n0 0 0 1")
    with pytest.raises(InputError, match=r"T\.txt: its shift is NaN or beyond 50 m"):
        read_base(tmp_path / "T.txt")


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (["--masks", "nowhere"], "--masks nowhere: no such folder"),
        (["--masks", "none.json"], "none.json"),
        (["--base", "T.txt"], "T.txt: holds 3 numbers"),
        (["--bop", "results.json"], "--bop results.json: name a .csv file"),
        (["--bop", "labels.csv"], "--bop labels.csv: is there already and holds no answers"),
        (["--bop", "shots"], "--bop shots: is a folder"),
        (["--json", "masks.json", "--masks", "masks.json"], "--json masks.json: is there already"),
        (["--csv", "a.csv", "--bop", "./a.csv"], "--csv and --bop name one file"),
    ],
)
def test_wrong_options_are_one_line(
    tmp_path, monkeypatch, typed, cad, shot, words, message
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("T.txt").write_text("1 2 3")
    held = {"labels.csv": "file,class\na.ply,rod\n", "masks.json": '[{"image_id": 4}]'}
    for name, text in held.items():
        Path(name).write_text(text)
    folder = captured(tmp_path / "shots", shot)
    assert message in typed.refuses("find", cad, folder, "--units", "mm", *words)
    assert {name: Path(name).read_text() for name in held} == held
