"""Frames of cameras: folders, a RealSense's recordings, ROS bags; all become one layout."""

import dataclasses
import json
import re
import time
from pathlib import Path

import cv2
import numpy as np
import pytest

from qs3 import reading
from qs3.errors import TOLD, InputError, MissingExtraError
from qs3.frames.camera_files import read_intrinsics
from qs3.frames.cameras import CaptureSettings, DepthFrame, open_camera
from qs3.frames.folder import capture
from qs3.frames.images import read_depth
from qs3.frames.intrinsics import Intrinsics
from qs3.objects.scene_files import SceneSettings, read_scene
from qs3.parts.scenes.frames import list_frames, read_frame

from ..clouds.hostile import refused
from .bags import RATE, write_realsense, write_ros1, write_ros2
from .table import frames


def read(camera: str, **more) -> list[DepthFrame]:
    return list(open_camera(CaptureSettings(camera, **more)))


def same(one: DepthFrame, other: DepthFrame) -> None:
    """Equal depths, to the bit, camera and times."""
    np.testing.assert_array_equal(one.depth, other.depth)
    cameras = (np.array(dataclasses.astuple(each.camera)[:7], float) for each in (one, other))
    np.testing.assert_allclose(*cameras, rtol=1e-6)
    assert one.timestamp == pytest.approx(other.timestamp, abs=1e-6)


def test_what_is_captured_is_what_the_folder_gives_back(tmp_path, monkeypatch):
    shots = list(frames(3))
    assert capture((frame for frame in shots), tmp_path / "shots") == 3
    for one, two in zip(shots, read(f"folder:{tmp_path / 'shots'}"), strict=True):
        same(two, one)
        assert one.name == two.name
    with refused("is there already"):
        capture(frames(1), tmp_path / "shots")
    (tmp_path / "here").mkdir()
    monkeypatch.chdir(tmp_path / "here")
    assert capture(frames(1), Path()) == 1


def test_numbers_with_a_point_lose_nothing_and_every_step_has_its_unit(tmp_path):
    rng = np.random.default_rng(0)
    for step in (None, 0.0001, 0.00025, 1e-5):
        camera = Intrinsics(50.0, 50.0, 4.0, 3.0, 9, 7, depth_scale=step)
        depth = rng.random((7, 9)).astype(np.float32) + np.float32(0.1)
        if step is not None:
            depth = np.rint(depth / np.float32(step)) * np.float32(step)
        depth[2, 3] = np.nan
        capture((frame for frame in [DepthFrame(depth, camera, "a")]), tmp_path / str(step))
        (back,) = read(f"folder:{tmp_path / str(step)}")
        np.testing.assert_array_equal(back.depth, depth)
        assert back.camera == camera
        assert back.timestamp is None


def test_what_no_png_holds_is_no_depth(tmp_path):
    camera = Intrinsics(50.0, 50.0, 0.0, 0.0, 2, 1, depth_scale=0.001)
    far = np.array([[65.534, 65.535]], np.float32)
    capture((frame for frame in [DepthFrame(far, camera, "a")]), tmp_path / "far")
    depth = read_depth(tmp_path / "far" / "depth" / "000000.png")
    assert depth[0, 0] == pytest.approx(65.534)
    assert np.isnan(depth[0, 1])


def test_a_stop_keeps_what_is_there(tmp_path):
    closed = []

    def stopped():
        try:
            yield from frames(2)
            raise KeyboardInterrupt
        finally:
            closed.append(True)

    with pytest.raises(KeyboardInterrupt):
        capture(stopped(), tmp_path / "shots")
    assert closed
    assert len(read(f"folder:{tmp_path / 'shots'}")) == 2
    left = {path.name for path in (tmp_path / "shots").rglob("*") if path.is_file()}
    assert left == {"000000.png", "000001.png", "intrinsics.json", "times.csv"}


def test_frames_and_every_choose(tmp_path):
    capture(frames(7), tmp_path / "shots")
    folder = f"folder:{tmp_path / 'shots'}"
    assert [frame.name for frame in read(folder, frames=2)] == ["000000", "000001"]
    chosen = [frame.name for frame in read(folder, every=3 / RATE)]
    assert chosen == ["000000", "000003", "000006"]
    (tmp_path / "shots" / "times.csv").unlink()
    assert len(read(folder, every=9.0)) == 7  # nothing tells when they were taken
    for wrong in ({"frames": 0}, {"every": -1.0}, {"every": float("nan")}):
        with pytest.raises(InputError):
            CaptureSettings("realsense", **wrong)


def test_a_folder_of_images_with_a_camera_beside_them(tmp_path, caplog):
    capture(frames(2), tmp_path / "shots")
    for path in (tmp_path / "shots" / "depth").iterdir():
        path.rename(tmp_path / path.name)
    with refused("has no camera file .*; put one there, or give .* as --intrinsics", tmp_path):
        read(f"folder:{tmp_path}")
    assert len(read(f"folder:{tmp_path}", intrinsics="224,224,159.5,119.5")) == 2
    (tmp_path / "K.txt").write_text("224 0 159.5 0 224 119.5 0 0 1")
    assert read_intrinsics(tmp_path).fx == 224
    assert len(read(f"folder:{tmp_path}")) == 2
    # The camera's file tells no size; that of the first frame is that of all.
    cv2.imwrite(str(tmp_path / "000002.png"), np.full((120, 160), 900, np.uint16))
    with refused("1 of 3 frames were left out", tmp_path):
        read(f"folder:{tmp_path}")
    assert f"{tmp_path / '000002.png'}: is 160×120 pixels, the camera 320×240" in caplog.text


def test_the_step_of_depth_is_that_of_the_images_whatever_camera_is_named(tmp_path):
    file = tmp_path / "000000.png"
    cv2.imwrite(str(file), np.full((240, 320), 6000, np.uint16))
    plain = {"fx": 224, "fy": 224, "cx": 159.5, "cy": 119.5, "depth_unit": 0.0001}
    (tmp_path / "camera.json").write_text(json.dumps(plain))
    for named, depth in (("230,230,159.5,119.5", 0.6), (tmp_path / "other.json", 1.2)):
        (tmp_path / "other.json").write_text(json.dumps(plain | {"depth_unit": 0.0002}))
        words = {"intrinsics": str(named)}
        (frame,) = read(f"folder:{tmp_path}", **words)
        searched = [read_frame(*list_frames(source, str(named)))[0] for source in (tmp_path, file)]
        heights = -read_scene(file, SceneSettings(**words))[0][:, 2]  # level: z is against gravity
        for metres in (frame.depth, *searched):
            np.testing.assert_allclose(metres, depth, rtol=1e-6)
        assert np.ptp(heights) == pytest.approx(depth * 239 / frame.camera.fy, rel=1e-4)


def test_camera_files_beside_each_other_agree_or_are_refused(tmp_path):
    (tmp_path / "K.txt").write_text("224 0 159.5 0 224 119.5 0 0 1")
    plain = {"fx": 224.01, "fy": 224, "cx": 159.5, "cy": 119.5, "depth_unit": 0.0001}
    (tmp_path / "camera.json").write_text(json.dumps(plain))
    assert read_intrinsics(tmp_path).depth_scale == 0.0001
    assert read_intrinsics(tmp_path).fx == 224.01
    (tmp_path / "K.txt").rename(tmp_path / "intrinsics.txt")  # is read first, and tells less
    assert read_intrinsics(tmp_path) == Intrinsics(224.0, 224.0, 159.5, 119.5, depth_scale=0.0001)
    (tmp_path / "camera_info.yaml").write_text("- no camera")
    (tmp_path / "intrinsics.txt").write_text("see camera.json")
    (tmp_path / "intrinsics.json").write_text('{"name": "my camera", "serial": 1}')
    assert read_intrinsics(tmp_path).depth_scale == 0.0001
    (tmp_path / "K.txt").write_text("448 0 319.5 0 448 239.5 0 0 1")
    with refused("K.txt beside it differs; remove one", tmp_path / "camera.json"):
        read_intrinsics(tmp_path)
    (tmp_path / "K.txt").unlink()
    (tmp_path / "camera.json").write_text(json.dumps(plain | {"is_fisheye": True}))
    with refused("its isfisheye is unknown", tmp_path / "camera.json"):
        read_intrinsics(tmp_path)
    (tmp_path / "camera.json").unlink()
    with refused("has neither fx nor a matrix", tmp_path / "intrinsics.json"):
        read_intrinsics(tmp_path)


def test_the_lens_is_that_of_the_first_camera_file(tmp_path, caplog):
    """Images without a lens may be straightened ones, beside the camera that took the others."""
    TOLD.clear()
    plain = {"fx": 224, "fy": 224, "cx": 159.5, "cy": 119.5}
    (tmp_path / "intrinsics.json").write_text(json.dumps(plain | {"distortion": [0, 0, 0, 0, 0]}))
    (tmp_path / "camera.json").write_text(json.dumps(plain | {"distortion": [0.3, 0, 0, 0, 0]}))
    assert read_intrinsics(tmp_path).distortion == ()
    assert "camera.json beside it has another lens, which does not count" in caplog.text
    (tmp_path / "intrinsics.json").write_text(json.dumps(plain | {"distortion": [0.1, 0, 0, 0, 0]}))
    with refused("camera.json beside it has another lens; remove one"):
        read_intrinsics(tmp_path)


@pytest.mark.parametrize("is_link", [False, True])
def test_a_damaged_frame_is_told_and_the_others_are_done(tmp_path, caplog, is_link):
    shots, again = tmp_path / "shots", tmp_path / "again"
    capture(frames(4), shots)
    damaged = shots / "depth" / "000001.png"
    damaged.write_bytes(damaged.read_bytes()[:200])
    if is_link:
        damaged.unlink()
        damaged.symlink_to(tmp_path / "nowhere.png")
    with refused("1 of 4 frames were left out, see above; the others are done", shots):
        capture(open_camera(CaptureSettings(f"folder:{shots}")), again)
    assert str(damaged) in caplog.text
    same = [("000000", "000000"), ("000001", "000002"), ("000002", "000003")]
    assert [path.stem for path in sorted((again / "depth").iterdir())] == [new for new, _ in same]
    times = read(f"folder:{shots}", frames=3)  # ends before what was left out is told as a fault
    got = read(f"folder:{again}")
    for (_, old), frame in zip(same, got, strict=True):
        depth = read_depth(shots / "depth" / f"{old}.png", 0.001)
        np.testing.assert_array_equal(frame.depth, depth)
    assert [frame.timestamp for frame in got] == [frame.timestamp for frame in times]
    (shots / "depth" / "000000.png").write_bytes(b"")
    with refused("the file is empty", shots / "depth" / "000000.png"):
        read(f"folder:{shots}")


def test_a_recording_of_a_realsense_gives_every_frame(tmp_path):
    """Recorded by librealsense itself, of a camera made of software."""
    pytest.importorskip("pyrealsense2", exc_type=ImportError)
    shots = list(frames(8))
    path = write_realsense(tmp_path / "shots", shots)
    got = []
    for frame in open_camera(CaptureSettings(f"bag:{path}")):
        got.append(frame)
        time.sleep(0.05)  # slower than the camera
    for one, two in zip(shots, got, strict=True):
        same(two, one)
    assert len(read(f"bag:{path}", every=3 / RATE)) == 3
    assert capture(open_camera(CaptureSettings(f"bag:{path}")), tmp_path / "out") == 8
    for one, two in zip(got, read(f"folder:{tmp_path / 'out'}"), strict=True):
        same(two, one)


def test_damaged_recordings_of_a_realsense_are_one_line(tmp_path):
    pytest.importorskip("pyrealsense2", exc_type=ImportError)
    with refused("no such file", "none.bag"):
        read(f"bag:{tmp_path / 'none.bag'}")
    for ending in (".bag", ".db3"):
        path = tmp_path / f"noise{ending}"
        path.write_bytes(np.random.default_rng(0).bytes(5000))
        with refused("librealsense", path):
            read(f"bag:{path}")
    with refused("is not connected", "realsense 000000000000"):
        read("realsense:000000000000")


@pytest.mark.parametrize("kind", ["ros1", "ros1-lz4", "db3", "mcap", "mcap-zstd", "message-zstd"])
@pytest.mark.parametrize("encoding", ["16UC1", "32FC1", "compressedDepth"])
def test_bags_of_ros_give_the_frames_that_went_in(tmp_path, kind, encoding):
    shots = list(frames(3, 64, 48))
    write = write_ros1 if kind.startswith("ros1") else write_ros2
    path = write(tmp_path / "bag", shots, encoding, kind)
    got = read(f"rosbag:{path}")
    if encoding == "32FC1":
        shots = [_in_metres(frame) for frame in shots]
    for one, two in zip(shots, got, strict=True):
        same(two, one)
    capture(open_camera(CaptureSettings(f"rosbag:{path}")), tmp_path / "out")
    for one, two in zip(shots, read(f"folder:{tmp_path / 'out'}"), strict=True):
        same(two, one)


@pytest.mark.parametrize("kind", ["ros1-lz4", "mcap-zstd", "message-zstd"])
def test_a_bag_that_unpacks_to_much_is_refused(tmp_path, kind, monkeypatch):
    (shot,) = frames(1, 64, 48)
    flat = dataclasses.replace(shot, depth=np.zeros((1500, 2000), np.float32))
    write = write_ros1 if kind == "ros1-lz4" else write_ros2
    path = write(tmp_path / "bag", [flat], "32FC1", kind)
    monkeypatch.setattr(reading, "_BASE", 1 << 20)
    with refused(r"a chunk has \d+ bytes, more than the limit", path):
        read(f"rosbag:{path}")


@pytest.mark.parametrize("kind", ["ros1", "mcap"])
@pytest.mark.parametrize(
    "encoding",
    [
        "16UC1; png compressed ", "16UC1; png compressed", "mono16; png compressed ", "mono16",
        "16UC1; compressedDepth", "mono16; compressedDepth png", "16UC1; tiff compressed ",
        "32FC1; tiff compressed ",
    ],
)  # fmt: skip
def test_depth_that_is_packed_without_loss_is_read(tmp_path, kind, encoding):
    shots = list(frames(2, 64, 48))
    path = (write_ros1 if kind == "ros1" else write_ros2)(tmp_path / "bag", shots, encoding, kind)
    got = read(f"rosbag:{path}")
    for one, two in zip(shots, got, strict=True):
        same(two, _in_metres(one) if encoding.startswith("32FC1") else one)


@pytest.mark.parametrize(
    "encoding",
    [
        "16SC1", "8UC1", "32SC1", "64FC1", "rgb8", "32FC1; compressedDepth png",
        "16UC1; compressedDepth rvl", "32FC1; compressedDepth rvl", "rgb8; jpeg compressed bgr8",
        "16UC1; jpeg compressed", "32FC1; png compressed ", "jpeg", "png",
    ],
)  # fmt: skip
@pytest.mark.parametrize("topic", ["", "own"])
def test_other_encodings_are_refused_with_topic_and_encoding(tmp_path, encoding, topic):
    path = write_ros1(tmp_path / "bag", list(frames(1, 64, 48)), encoding, "ros1")
    name = "/camera/depth/image_raw"
    if ";" in encoding or encoding in ("jpeg", "png"):
        name += "/compressedDepth" if "compressedDepth" in encoding else "/compressed"
    with refused("--topic must name one topic of depth images: none", path):
        read(f"rosbag:{path}", topic=name if topic else "")
    with refused(re.escape(f"its images are {name} ({encoding.strip()})"), path):
        read(f"rosbag:{path}")


def test_packed_depth_that_is_not_what_it_says_is_refused(tmp_path):
    shots = list(frames(1, 64, 48))
    path = write_ros1(tmp_path / "bag", shots, "16UC1; png compressed ", "ros1")
    content = path.read_bytes()
    path.write_bytes(content.replace(b"\x89PNG", b"\x89JPG"))
    with refused("not a PNG or TIFF file", path, "/camera/depth/image_raw/compressed"):
        read(f"rosbag:{path}")


def test_depth_of_a_wrong_unit_is_refused_with_what_capture_has(tmp_path):
    millimetres = [
        dataclasses.replace(frame, depth=frame.depth * np.float32(1000))
        for frame in frames(1, 64, 48)
    ]
    path = write_ros1(tmp_path / "bag", millimetres, "32FC1", "ros1")
    with refused("give as --intrinsics a JSON file .* depth_unit", path):
        read(f"rosbag:{path}")
    (tmp_path / "camera.json").write_text(json.dumps(WHOLE | {"depth_unit": 0.001}))
    (frame,) = read(f"rosbag:{path}", intrinsics=str(tmp_path / "camera.json"))
    np.testing.assert_allclose(frame.depth, millimetres[0].depth / 1000, rtol=1e-6)


def test_depth_of_a_large_place_comes_back_from_its_folder(tmp_path):
    camera = Intrinsics(50.0, 50.0, 4.0, 3.0, 9, 7)
    depth = np.full((7, 9), 40, np.float32)
    capture((frame for frame in [DepthFrame(depth, camera, "a")]), tmp_path / "shots")
    np.testing.assert_array_equal(read(f"folder:{tmp_path / 'shots'}")[0].depth, depth)


def test_the_small_bags_are_read_or_refused(shared_data):
    faults = shared_data / "faults"
    (frame,) = read(f"rosbag:{faults / 'r_png.bag'}")
    assert frame.depth.shape == (48, 64)
    np.testing.assert_allclose(np.unique(frame.depth[frame.depth > 0]), [0.8, 2.0], rtol=1e-6)
    for name, encoding in (
        ("r_32", r"/d/image/compressedDepth \(32FC1; compressedDepth\)"),
        ("r_16sc", r"/d/image \(16SC1\)"),
    ):
        with refused(encoding, f"{name}.bag"):
            read(f"rosbag:{faults / name}.bag")
    with pytest.raises(InputError, match="/d/image: its middle depth would be 2000 m") as caught:
        read(f"rosbag:{faults / 'r_zmm.bag'}")
    assert set(re.findall(r"--[a-z-]+", str(caught.value))) <= {"--intrinsics"}


def _in_metres(frame: DepthFrame) -> DepthFrame:
    camera = dataclasses.replace(frame.camera, depth_scale=None)
    return dataclasses.replace(frame, camera=camera)


def test_convention_ros_rows_are_padded_big_endian_and_rectified(tmp_path, caplog):
    TOLD.clear()
    shots = list(frames(1, 64, 48))
    path = write_ros1(tmp_path / "bag", shots, "16UC1", "ros1", big=True, padding=6)
    same(read(f"rosbag:{path}")[0], shots[0])
    # K and D are those of the lens; what is rectified has P.
    path = write_ros1(tmp_path / "raw", shots, "16UC1", "ros1", lens=(0.1, 0, 0, 0, 0))
    capture(open_camera(CaptureSettings(f"rosbag:{path}")), tmp_path / "out")
    assert read(f"folder:{tmp_path / 'out'}")[0].camera.distortion == (0.1, 0, 0, 0, 0)
    assert "lens distortion, which is undone" in caplog.text
    caplog.clear()
    more = {"lens": (0.1, 0, 0, 0, 0), "name": "/camera/depth/image_rect_raw"}
    path = write_ros1(tmp_path / "rect", shots, "16UC1", "ros1", **more)
    assert read(f"rosbag:{path}")[0].camera.fx == pytest.approx(shots[0].camera.fx + 1)
    assert not caplog.text


WHOLE = {"fx": 44.8, "fy": 44.8, "cx": 31.5, "cy": 23.5}


@pytest.mark.parametrize("write", [write_ros1, write_ros2])
@pytest.mark.parametrize(
    "facts", [{"p": np.zeros(12)}, {"k": np.zeros(9)}, {"width": 0, "height": 0}]
)
def test_zeros_of_a_camera_info_are_what_it_does_not_know(tmp_path, write, facts):
    kind = "ros1" if write is write_ros1 else "mcap"
    for name in ("/camera/direct/image_raw", "/camera/depth/image_rect_raw"):
        where = {"name": name} if write is write_ros1 else {"topics": (name,)}
        shots, place = list(frames(1, 64, 48)), tmp_path / name.split("_")[1]
        path = write(place, shots, "16UC1", kind, facts=(facts,), **where)
        (frame,) = read(f"rosbag:{path}")
        assert {name: getattr(frame.camera, name) for name in WHOLE} == pytest.approx(WHOLE)
        assert (frame.camera.width, frame.camera.height) == (64, 48)


@pytest.mark.parametrize(
    ("facts", "words"),
    [
        (({"width": 128, "height": 96},), "is 64×48 pixels, the camera 128×96"),
        (({"width": 48, "height": 64},), "is 64×48 pixels, the camera 48×64"),
        (({"binning_x": 2, "binning_y": 2},), "has binning or a roi; give --intrinsics"),
        (({"k": np.zeros(9), "p": np.zeros(12)},), "has neither fx nor a matrix"),
        (({"model": "own", "d": np.ones(5)},), "cannot be undone"),
        (({"frame_id": "colour"},), "has no CameraInfo beside it"),
        (({}, {"k": np.diag([50.0, 50.0, 1.0]).ravel()}), "changes on the way"),
    ],
)
def test_a_camera_info_of_other_images_is_refused(tmp_path, facts, words):
    path = write_ros1(tmp_path / "bag", list(frames(2, 64, 48)), "16UC1", "ros1", facts=facts)
    with refused(words, path):
        read(f"rosbag:{path}")


def test_definitions_that_a_bag_brings_are_not_looked_at(tmp_path):
    shots = list(frames(1, 64, 48))
    for brings in ("import os", "uint8[] data\n", "string encoding=__import__('os')\n"):
        path = write_ros1(tmp_path / str(len(brings)), shots, "16UC1", "ros1", brings=brings)
        same(read(f"rosbag:{path}")[0], shots[0])


def test_topics_are_found_or_asked_for(tmp_path):
    shots = list(frames(1, 64, 48))
    two = write_ros2(tmp_path / "two", shots, "16UC1", "db3", topics=("/a/depth", "/b/depth"))
    with refused("--topic must name one", "/a/depth, /b/depth"):
        read(f"rosbag:{two}")
    assert len(read(f"rosbag:{two}", topic="/b/depth")) == 1
    with refused("--topic must name one", "/a/depth"):
        read(f"rosbag:{two}", topic="/c")
    colour = write_ros1(tmp_path / "colour", shots, "rgb8", "ros1")
    with refused("--topic must name one topic of depth images"):
        read(f"rosbag:{colour}")
    alone = write_ros1(tmp_path / "alone", shots, "16UC1", "ros1", info=False)
    with refused("no CameraInfo", "--intrinsics"):
        read(f"rosbag:{alone}")
    assert len(read(f"rosbag:{alone}", intrinsics="44.8,44.8,31.5,23.5")) == 1
    of_realsense = write_ros1(
        tmp_path / "own", shots, "16UC1", "ros1", name="/device_0/sensor_0/Depth_0/x"
    )
    with refused("recorded by a RealSense", f"bag:{of_realsense}"):
        read(f"rosbag:{of_realsense}")
    with refused("is 64×48 pixels, the camera 9×9"):
        (tmp_path / "k.json").write_text(
            json.dumps({"fx": 9, "fy": 9, "cx": 4, "cy": 4, "width": 9, "height": 9})
        )
        read(f"rosbag:{alone}", intrinsics=str(tmp_path / "k.json"))


def test_a_message_of_another_size_is_refused(tmp_path):
    shots = list(frames(1, 64, 48))
    for change in ({"width": 65}, {"height": 49}, {"step": 0}):
        path = write_ros1(tmp_path / str(change), shots, "16UC1", "ros1", **change)
        with refused("cannot be read as a ROS bag", path):
            read(f"rosbag:{path}")


@pytest.mark.parametrize("kind", ["ros1", "db3", "mcap"])
def test_a_cut_bag_of_ros_is_one_line(tmp_path, kind):
    write = write_ros1 if kind == "ros1" else write_ros2
    path = write(tmp_path / "bag", list(frames(2, 16, 12)), "16UC1", kind)
    file = path if path.is_file() else next(one for one in path.iterdir() if one.suffix != ".yaml")
    file.write_bytes(file.read_bytes()[:200])
    with refused("cannot be read as a ROS bag", path):
        read(f"rosbag:{path}")


def test_what_is_no_camera_is_one_line(tmp_path, monkeypatch):
    for camera in ("kinect", "bag:", "folder:", "rosbag:"):
        with refused("name realsense, realsense:SERIAL, bag:FILE"):
            read(camera)
    with refused("no such file"):
        read(f"rosbag:{tmp_path / 'x'}")
    with refused("no such folder", "x"):
        read(f"folder:{tmp_path / 'x'}")
    with refused("no depth image"):
        read(f"folder:{tmp_path}")
    with refused("gave no frame"):
        capture((frame for frame in ()), tmp_path / "out")
    assert not (tmp_path / "out").exists()
    import sys

    for module, camera, extra in (
        ("pyrealsense2", "realsense", "realsense"),
        ("rosbags", f"rosbag:{__file__}", "ros"),
    ):
        monkeypatch.setitem(sys.modules, module, None)
        with pytest.raises(MissingExtraError, match=rf"'.\[{extra}\]'"):
            read(camera)


def test_a_bad_table_of_times_is_refused(tmp_path):
    out = tmp_path / "shots"
    capture(frames(2), out)
    times = (out / "times.csv").read_text()
    (out / "times.csv").write_text(times, encoding="utf-8-sig")  # as Excel writes it
    assert None not in [frame.timestamp for frame in read(f"folder:{out}")]
    (out / "times.csv").write_text("name,when\na,b\n")
    with refused("columns frame,time", "times.csv"):
        read(f"folder:{out}")


def test_a_camera_as_numpy_saves_it_is_read(tmp_path):
    matrix = np.array([[610.0, 0, 318], [0, 611, 242], [0, 0, 1]])
    for number, numbers in enumerate((matrix, matrix.astype(np.float32).ravel())):
        np.save(tmp_path / f"{number}.npy", numbers)
        camera = read_intrinsics(tmp_path / f"{number}.npy", 0.001)
        assert camera == Intrinsics(610.0, 611.0, 318.0, 242.0, depth_scale=0.001)
    np.save(tmp_path / "depth.npy", np.ones((6, 8)))
    with refused("the matrix must be 3×3 numbers, not 48", tmp_path / "depth.npy"):
        read_intrinsics(tmp_path / "depth.npy")
    np.savez(tmp_path / "K.npz", K=matrix)
    with refused("is no text; give fx,fy,cx,cy", tmp_path / "K.npz"):
        read_intrinsics(tmp_path / "K.npz")
