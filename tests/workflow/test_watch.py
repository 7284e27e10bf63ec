"""What stands before a camera: frames of a table to classes and places."""

import json
from dataclasses import replace
from inspect import signature
from pathlib import Path

import numpy as np
import pytest

from qs3.cli.watch import watch as watch_verb
from qs3.errors import InputError
from qs3.frames.cameras import CaptureSettings, DepthFrame, open_camera
from qs3.frames.folder import capture
from qs3.frames.intrinsics import Intrinsics
from qs3.objects.scene_files import SceneSettings, lift_scene, segment_scene
from qs3.objects.segment import SegmentSettings, segment
from qs3.training.predict import load_model
from qs3.workflow.watch import predict_objects, rows, watch

from ..frames.bags import write_ros1
from ..frames.table import frames


@pytest.fixture(scope="module")
def shots(tmp_path_factory):
    out = tmp_path_factory.mktemp("watch") / "shots"
    capture(frames(3), out)
    return out


def test_the_objects_of_a_frame_get_the_answers_that_each_gets_alone():
    loaded = load_model(Path("rooms"))
    (frame,) = frames(1)
    settings = SegmentSettings()
    items = segment(lift_scene(frame.depth, frame.camera, settings, "frame"), settings)
    assert len({len(item.points) for item in items}) > 2
    for item, (seen, answer) in zip(items, predict_objects(loaded, items), strict=True):
        assert seen is item
        if len(item.points) <= 1024:
            alone = loaded.describe(item.points[None]).probabilities[0]
            expected = [answer.probabilities[name] for name in loaded.class_names]
            np.testing.assert_allclose(expected, alone, atol=1e-6)
        shares = list(answer.probabilities.values())
        assert answer.best()[0][1] == max(shares)
        assert shares == sorted(shares, reverse=True)


def test_noise_of_a_camera_far_away_is_no_object():
    """At 2.5 m it is larger than the tolerance; the boxes stand out from it all the same."""
    rng = np.random.default_rng(0)
    floor = np.c_[rng.random((60_000, 2)) * 2.0 - 1.0, np.zeros(60_000)]
    things = [rng.random((4000, 3)) * 0.4 + [x, y, 0.0] for x, y in ((-0.6, -0.5), (0.3, 0.2))]
    scene = np.concatenate([floor, *things]) - [0.0, -2.0, 1.5]  # the camera is at the origin
    reach = np.linalg.norm(scene, axis=1, keepdims=True)
    scene += 0.003 * reach * rng.normal(size=(len(scene), 1)) * scene  # along the rays
    far = {"height": 1.0, "gap": 0.05}
    assert len(segment(scene, SegmentSettings(noise=0.003, **far))) == 2
    assert len(segment(scene, SegmentSettings(noise=0.0, tolerance=0.01, **far))) != 2
    with pytest.raises(InputError, match="noise"):
        SegmentSettings(noise=-1.0)


def test_a_frame_without_objects_is_reported_and_the_next_is_read():
    (good,) = frames(1)
    camera = Intrinsics(50.0, 50.0, 4.0, 4.0, 9, 9)
    blind = DepthFrame(np.full((9, 9), np.nan, np.float32), camera, "blind")
    closed = []

    def camera_of_mine():
        try:
            yield blind
            yield good
            yield blind
        finally:
            closed.append(True)

    seen = []
    for frame in watch("rooms", camera_of_mine(), SegmentSettings()):
        seen.append(frame)
        if frame.objects:
            break
    assert [bool(frame.objects) for frame in seen] == [False, True]
    assert "no depth in it" in seen[0].fault
    del frame
    assert closed
    assert [list(row) for row in rows(seen[0])] == [["frame", "time", "fault"]]


def test_a_frame_is_cut_as_segment_cuts_its_picture(shots, tmp_path):
    default = signature(watch_verb).parameters["settings"].default
    assert default == replace(SegmentSettings(), noise=default.noise)
    (first, *_) = watch("rooms", open_camera(CaptureSettings(f"folder:{shots}")), default)
    settings = SceneSettings(intrinsics=str(shots), noise=default.noise)
    cut = segment_scene(next(iter(sorted((shots / "depth").iterdir()))), tmp_path / "cut", settings)
    assert len(cut) == len(first.objects)
    for item, (seen, _) in zip(cut, first.objects, strict=True):
        np.testing.assert_array_equal(seen.points, item.points)


def test_the_verbs_from_a_bag_to_answers(tmp_path, typed):
    bag = write_ros1(tmp_path / "bag", list(frames(3)), "16UC1", "ros1-lz4")
    done = typed("capture", "--camera", f"rosbag:{bag}", "--out", tmp_path / "a", "--frames", 2)
    assert done.stdout.strip() == str(tmp_path / "a")
    assert done.stderr.startswith("2 frames.")
    folder = f"folder:{tmp_path / 'a'}"
    typed("capture", "--camera", folder, "--out", tmp_path / "b")
    first, second = (tmp_path / name / "depth" / "000001.png" for name in "ab")
    assert first.read_bytes() == second.read_bytes()
    done = typed("watch", "rooms", "--camera", f"folder:{tmp_path / 'b'}", "--json")
    seen = [json.loads(line) for line in done.stdout.splitlines()]
    assert {row["frame"] for row in seen} == {"000000", "000001"}
    assert sum(row["frame"] == "000000" for row in seen) >= 3
    assert len(seen[0]["probabilities"]) == 10
    done = typed("watch", "rooms", "--camera", folder, "--frames", 1)
    assert done.stdout.startswith(f"000000\t{seen[0]['class']} 0.")
    typed.refuses("capture", "--camera", f"bag:{tmp_path}/none.bag", "--out", tmp_path / "c")
