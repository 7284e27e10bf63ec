"""``qs3 extract`` as a user runs it."""

import json
import shutil

import numpy as np
import pytest

from qs3.answers.cloud_files import list_clouds
from qs3.cli.extract import _show_counts
from qs3.clouds.layouts.folders import read_folder
from qs3.clouds.layouts.store import read_ragged
from qs3.clouds.load import load_unlabelled
from qs3.errors import InputError
from qs3.frames.folder import capture
from qs3.objects.run import ExtractReport
from qs3.objects.scene_files import SceneSettings, list_scenes, segment_scene, segment_scenes
from qs3.store.manifest import open_dataset

from ..frames.table import frames
from ..objects.depth_scene import write_png


@pytest.fixture
def pictures(tmp_path):
    """Three depth images of a slanted board at about 1 m, and masks of two boards in each."""
    u, v = np.meshgrid(np.arange(60), np.arange(40))
    mask = np.where((u > 10) & (u < 30) & (v > 5) & (v < 35), 1, 0)
    mask[(u > 35) & (u < 50) & (v > 10) & (v < 30)] = 2
    for index in range(3):
        depth = np.where(mask > 0, 1000 + 2 * u + 10 * index, 0).astype(np.uint16)
        write_png(tmp_path / "depth" / f"{index}.png", depth)
        write_png(tmp_path / "mask" / f"{index}.png", mask.astype(np.uint8))
    return tmp_path


def test_depth_images_become_a_data_set_that_others_read(typed, pictures):
    out = pictures / "out"
    arguments = ("depth", pictures / "depth", "--mask", pictures / "mask", "--out", out,
                 "--intrinsics", "50,50,29.5,19.5", "--class", "table", "--num-points", "300",
                 "--workers", "0")  # fmt: skip
    done = typed("extract", *arguments)
    assert "3 objects of 3" in done.stderr
    data = read_ragged(out)
    assert data.ids == ("0", "1", "2")
    assert data.class_names == ("table",)
    assert {len(cloud) for cloud in data.clouds} == {300}
    assert data.clouds[0][:, 1].min() == pytest.approx(1.022, abs=0.002)
    assert len(load_unlabelled(out, num_points=128)) == 3
    settings = open_dataset(out).settings
    assert settings["camera"]["fx"] == 50
    assert settings["cut"]["far"] is None
    # Again: nothing to do. With other settings: refused.
    assert "0 frames or scenes done, 3 were there before" in typed("extract", *arguments).stderr
    assert "erode" in typed.refuses("extract", *arguments, "--erode", "1")


def test_a_bad_image_fails_alone_and_is_told(typed, pictures):
    write_png(pictures / "depth" / "1.png", np.ones((40, 60), np.uint8))
    done = typed("extract", "depth", pictures / "depth", "--mask", pictures / "mask", "--out",
                 pictures / "out", "--intrinsics", "50,50,29,19", "--workers", "0",
                 code=2)  # fmt: skip
    line = done.stderr.splitlines()[-1]
    assert "1 scenes or frames failed; the first: 1:" in line
    assert "save depth as 16-bit PNG" in line
    assert read_ragged(pictures / "out").ids == ("0", "2")


@pytest.mark.parametrize(
    ("arguments", "word"),
    [
        (["depth", "D", "--mask", "M"], "--intrinsics"),
        (["depth", "D", "--intrinsics", "50,50,29,19"], "--mask FILE|DIR"),
        (["nyuv2", "D"], "nyu_depth_v2_labeled.mat: no such file"),
        (["scannet", "D", "--classes", "all"], "name the classes"),
    ],
)  # fmt: skip
def test_bad_options_are_one_line_and_leave_nothing(typed, pictures, arguments, word):
    places = {"D": pictures / "depth", "M": pictures / "mask"}
    options = [places.get(word, word) for word in arguments]
    assert word in typed.refuses("extract", *options, "--out", pictures / "out")
    assert not (pictures / "out").exists()


def test_a_scene_in_bops_layout(typed, pictures):
    scene = pictures / "000001"
    camera = {"cam_K": [50, 0, 29, 0, 50, 19, 0, 0, 1], "depth_scale": 1.0}
    world = {"cam_R_w2c": [1, 0, 0, 0, 0, -1, 0, 1, 0], "cam_t_w2c": [0, 0, 0]}
    for name, value in {"camera": camera, "gt": [{"obj_id": 4}]}.items():
        table = dict.fromkeys(range(3), value)
        (pictures / "000001").mkdir(exist_ok=True)
        (scene / f"scene_{name}.json").write_text(json.dumps(table))
    for index in range(3):
        (pictures / "depth" / f"{index}.png").rename(pictures / "depth" / f"{index:06d}.png")
        mask = pictures / "mask" / f"{index}.png"
        mask.rename(mask.with_name(f"{index:06d}_000000.png"))
    (pictures / "depth").rename(scene / "depth")
    (pictures / "mask").rename(scene / "mask_visib")
    done = typed("extract", "depth", scene, "--out", pictures / "a", "--workers", "0")
    assert "axes of the camera" in done.stderr
    (scene / "scene_camera.json").write_text(json.dumps(dict.fromkeys(range(3), camera | world)))
    done = typed("extract", "depth", pictures, "--out", pictures / "b", "--workers", "0",
                "--class", "desk")  # fmt: skip
    assert "axes of the world" in done.stderr
    first, second = read_ragged(pictures / "a"), read_ragged(pictures / "b")
    assert first.class_names == ("obj_000004",)
    assert second.class_names == ("desk",)
    # World to camera is (x, −z, y): the world is the camera's frame turned upright.
    np.testing.assert_allclose(first.clouds[1], second.clouds[1], atol=1e-6)
    for flag in (["--intrinsics", "5,5,2,1"], ["--instances"], ["--depth-scale", "1"]):
        assert "leave it out" in typed.refuses(
            "extract", "depth", scene, "--out", pictures / "x", *flag
        )


def test_every_frame_of_a_capture_becomes_a_folder_of_objects(typed, tmp_path, caplog):
    """What cannot be cut is told, the others are done, and the same command goes on."""
    shots, objects = tmp_path / "shots", tmp_path / "objects"
    capture(frames(3), shots)
    damaged = shots / "depth" / "000001.png"
    whole = damaged.read_bytes()
    damaged.write_bytes(whole[:100])
    done = typed("segment", shots, "--out", objects, code=2)
    assert f"qs3: {damaged}: cut off or damaged" in done.stderr
    assert "(1 of 3 scenes failed)" in done.stderr
    settings = SceneSettings(intrinsics=str(shots))
    for name in ("000000", "000002"):
        alone = segment_scene(shots / "depth" / f"{name}.png", tmp_path / name, settings)
        files = sorted(path.name for path in (tmp_path / name).iterdir())
        assert len(files) == len(alone) + 2  # objects.csv and scene.json
        assert {p.name for p in (objects / name).iterdir()} == {*files, "segment.json", "scene.png"}
        for file in files:
            assert (objects / name / file).read_bytes() == (tmp_path / name / file).read_bytes()
    assert not (objects / "000001").exists()
    clouds = read_folder(objects)
    assert {name.partition("/")[0] for name in clouds.ids} == {"000000", "000002"}
    assert clouds.labels is None  # a frame is no class
    assert len(load_unlabelled(objects, num_points=64)) == len(clouds.ids)
    damaged.write_bytes(whole)
    done = typed("segment", shots, "--out", objects)
    assert done.stdout.startswith("000001\t")
    assert "2 scenes were there before" in done.stderr
    (objects / ".000000.abcdef12.tmp" / "000000").mkdir(parents=True)  # of a killed process
    shutil.copy(objects / "000000" / "object_000.ply", objects / ".000000.abcdef12.tmp" / "000000")
    assert len(list_clouds([objects])) == sum(1 for _ in objects.glob("0*/*.ply"))
    earlier = json.loads((objects / "000000" / "segment.json").read_text())
    earlier["settings"]["plane_height"] = "None"  # a setting of earlier releases
    (objects / "000000" / "segment.json").write_text(json.dumps(earlier))
    assert "3 scenes were there before" in typed("segment", shots, "--out", objects).stderr
    # Other settings, another camera and another image are other scenes.
    camera = (shots / "intrinsics.json").read_text()
    other = json.dumps(json.loads(camera) | {"fx": 300.0})
    damaged.write_bytes((shots / "depth" / "000002.png").read_bytes())
    for words, text, count in (((), camera, 1), (("--gap", 0.03), camera, 3), ((), other, 3)):
        (shots / "intrinsics.json").write_text(text)
        done = typed("segment", shots, *words, "--out", objects, code=2)
        assert f"{count} of 3 scenes failed" in done.stderr
        assert "000001: is there already, of another picture or with other settings" in done.stderr
    assert "keeps" not in caplog.text
    damaged.unlink()
    (shots / "intrinsics.json").write_text(camera)
    typed("segment", shots, "--out", objects)
    assert f"{objects}: keeps 000001, of no scene that is there; remove them if" in caplog.text


def test_what_is_no_folder_of_scenes_or_objects_is_left_alone(typed, tmp_path):
    scenes, out = tmp_path / "scenes", tmp_path / "out"
    scenes.mkdir()
    (scenes / "readme.txt").write_text("clouds of Monday")
    assert f"{scenes}: no cloud" in typed.refuses("segment", scenes, "--out", out)
    np.save(scenes / "a.npy", np.zeros((9, 3)))
    line = typed.refuses("segment", scenes, "--intrinsics", tmp_path / "no.json", "--out", out)
    assert "no.json" in line
    assert not out.exists()
    out.mkdir()
    (out / "a").symlink_to(tmp_path / "elsewhere")
    done = typed("segment", scenes, "--out", out, code=2)
    assert "holds something else (a)" in done.stderr
    (tmp_path / "elsewhere").mkdir()
    (tmp_path / "elsewhere" / "segment.json").write_text("{}")
    done = typed("segment", scenes, "--out", out, code=2)
    assert "holds something else (a)" in done.stderr
    assert [path.name for path in (tmp_path / "elsewhere").iterdir()] == ["segment.json"]


def test_a_scene_of_one_class_stays_that_class(tmp_path):
    """Only what was made of a folder of scenes has no classes, at whatever depth."""
    (frame,) = frames(1)
    capture((frame for frame in [frame]), tmp_path / "shots")
    scenes, settings = list_scenes(tmp_path / "shots", SceneSettings())
    for name in ("chair", "mug"):
        segment_scene(scenes["000000"], tmp_path / "data" / name, settings)
    assert read_folder(tmp_path / "data").class_names == ("chair", "mug")
    list(segment_scenes(scenes | {"b": scenes["000000"]}, tmp_path / "split" / "train", settings))
    clouds = read_folder(tmp_path / "split")
    assert clouds.labels is None
    assert set(clouds.splits) == {"train"}


def test_an_extraction_without_any_object_is_a_fault(tmp_path, capfd):
    with pytest.raises(InputError, match="no object was found: wrong classes, or none of 100"):
        _show_counts(str(tmp_path), ExtractReport(0, 3, 0, 0, None, 100))
    printed = capfd.readouterr()
    assert printed.out == ""
    assert "Next:" not in printed.err  # there is nothing to go on with
