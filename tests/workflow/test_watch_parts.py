"""``qs3 watch`` with CAD: parts with poses, a page of them, and a camera that is unplugged."""

import functools
import json
import urllib.request
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from qs3.errors import TOLD, InputError
from qs3.evaluation.poses import adds
from qs3.frames.cameras import CaptureSettings, DepthFrame
from qs3.frames.folder import capture
from qs3.frames.intrinsics import Intrinsics
from qs3.objects.segment import SegmentSettings, no_plane
from qs3.parts import Library
from qs3.parts.scenes import finding
from qs3.parts.scenes.found import FoundPart, FoundParts
from qs3.workflow import watch as watching

from ..browser import Browser, until
from ..parts.scenes.tables import PARTS, lain, shoot
from ..stores import view_once

CAMERA = Intrinsics(430.0, 430.0, 159.5, 119.5, 320, 240)


@functools.cache
def shot(step: int):
    return shoot(lain("bracket", -0.06 + 0.004 * step, 0.0, 30), lain("pin", 0.06, 0.0), seed=step)


def frames(count: int):
    for step in range(count):
        yield DepthFrame(shot(step).depth, CAMERA, f"{step:06d}", step / 10)


@pytest.fixture(scope="module")
def shots(tmp_path_factory):
    out = tmp_path_factory.mktemp("parts") / "shots"
    capture(frames(3), out)
    return out


@pytest.fixture(scope="module")
def cad(tmp_path_factory):
    folder = tmp_path_factory.mktemp("cad")
    for name, mesh in PARTS.items():
        mesh.copy().apply_scale(1000).export(folder / f"{name}.stl")
    return folder


@pytest.fixture(scope="module")
def library() -> Library:
    return Library(tuple(view_once(mesh, 1.0, name, name) for name, mesh in PARTS.items()))


def test_one_line_per_part_per_frame(typed, cad, shots, tmp_path) -> None:
    camera, base = f"folder:{shots}", np.eye(4)
    base[:3, :3], base[:3, 3] = Rotation.from_euler("x", 180, degrees=True).as_matrix(), (0, 1, 2)
    np.savetxt(tmp_path / "base.txt", base)
    words = ("watch", cad, "--units", "mm", "--camera", camera, "--no-view")
    typed_lines = typed(*words, "--json", "--base", tmp_path / "base.txt").stdout.splitlines()
    lines = [json.loads(line) for line in typed_lines]
    assert [line["frame"] for line in lines] == [f"{k:06d}" for k in range(3) for _ in "ab"]
    for line in lines:
        true = dict(zip(("bracket", "pin"), shot(int(line["frame"])).poses, strict=True))
        pose, vertices = np.array(line["pose"]), np.asarray(PARTS[line["class"]].vertices)
        assert adds(pose, true[line["class"]], vertices) < 0.003
        np.testing.assert_allclose(line["base_from_part"], base @ pose, atol=1e-12)
    sure = typed(*words, "--frames", 1, "--least-score", 1).stdout.splitlines()
    assert {line.split()[1] for line in sure} == {"unexplained"}
    text = typed(*words, "--frames", 1).stdout.splitlines()
    assert len(text) == 2
    assert all("score" in line and "turned" in line for line in text)


def test_options_of_the_other_kind_of_run_are_refused(typed, cad, shots, tmp_path) -> None:
    camera = ("--camera", f"folder:{shots}", "--no-view")
    assert "--unknown" in typed.refuses("watch", cad, "--units", "mm", *camera, "--unknown", 0.1)
    assert "--units" in typed.refuses("watch", "rooms", "--units", "mm", *camera)
    np.savetxt(base := tmp_path / "base.txt", np.eye(4))
    for words in (("--least-score", 0.7), ("--base", base)):
        assert words[0] in typed.refuses("watch", "rooms", *words, *camera)
    assert "least" in typed.refuses("watch", cad, "--units", "mm", *camera, "--least-score", 2)
    assert "not a run" in typed.refuses("watch", tmp_path / "none", *camera)


def test_a_frame_with_a_fault_is_reported_and_the_parts_are_followed_on(library) -> None:
    def camera():
        yield DepthFrame(shot(0).depth, CAMERA, "0")
        yield DepthFrame(np.full((240, 320), np.nan, np.float32), CAMERA, "hand")
        yield DepthFrame(shot(1).depth[:100], CAMERA, "other")
        yield DepthFrame(shot(1).depth, CAMERA, "1")

    seen = list(watching.watch_parts(library, camera(), SegmentSettings()))
    assert [one.frame.name for one in seen] == ["0", "hand", "other", "1"]
    assert ["no depth" in seen[1].fault, "320×240" in seen[2].fault] == [True, True]
    assert [len(one.found.parts) if one.found else None for one in seen] == [2, None, None, 2]
    assert list(watching.part_rows(seen[1])[0]) == ["frame", "time", "seconds", "fault"]


@pytest.mark.parametrize("order", ["full table", "table full", "table full table full full"])
def test_each_frame_is_searched_with_its_table_or_without(library, monkeypatch, caplog, order):
    """A bin that fills or empties while it is watched; its frames are depths of one value."""
    TOLD.clear()
    known, searched = {"table": 1.0, "full": 2.0}, []

    def cut(depth, camera, settings, masks=None, *, table=True):
        if table and depth[0, 0] == known["full"]:
            raise no_plane("no level plane", settings)
        return "with" if table else "without"

    def found(library, picture, settings, before=None):
        searched.append((picture, before))
        part = FoundPart(
            "pin", "pin", np.eye(4), 0.9, 0.0, 0.0, 0.0, 1.0, 99, library.parts[0].symmetry
        )
        return FoundParts((part,), (), np.eye(4) if picture == "with" else None)

    monkeypatch.setattr(finding, "picture_of", cut)
    monkeypatch.setattr(finding, "find_in", found)
    words = order.split()
    camera = (DepthFrame(np.full((4, 4), known[w], np.float32), CAMERA, w) for w in words)
    seen = list(watching.watch_parts(library, camera, SegmentSettings()))
    assert [one.fault for one in seen] == [""] * len(words)
    assert [p for p, _ in searched] == [{"table": "with", "full": "without"}[w] for w in words]
    # Whatever the frames, the parts of the last one are followed.
    assert [before for _, before in searched] == [None, *(one.found for one in seen[:-1])]
    assert [record.getMessage() for record in caplog.records] == [
        "no table: no level plane, so it is searched without one; give --gravity"
    ]


def test_a_table_without_parts_is_searched_again_after_some_frames(library, monkeypatch) -> None:
    """A side of a part may have been missed; so may what no part explains."""
    monkeypatch.setattr(watching, "_AGAIN", 3)
    round_ = np.hypot(*np.mgrid[-120:120, -160:160]) < 26
    tray = np.where(round_, shoot().depth, np.float32(0))
    searched, plain = [], finding.picture_of

    def counted(*args, table=True):
        searched[-1] += not table
        return plain(*args, table=table)

    def camera():
        for number in range(5):
            searched.append(0)
            yield DepthFrame(tray, CAMERA, str(number))

    monkeypatch.setattr(finding, "picture_of", counted)
    seen = watching.watch_parts(library.only(["bracket"]), camera(), SegmentSettings())
    assert not any(one.found.parts for one in seen)
    assert searched == [1, 0, 0, 1, 0]


def test_every_other_pixel_gives_the_same_poses(library) -> None:
    (one,) = watching.watch_parts(library, frames(1), SegmentSettings(stride=2, min_points=40))
    assert one.found is not None
    assert sorted(part.class_name for part in one.found.parts) == ["bracket", "pin"]
    true = dict(zip(("bracket", "pin"), shot(0).poses, strict=True))
    for part in one.found.parts:
        vertices = np.asarray(PARTS[part.class_name].vertices)
        assert adds(part.pose, true[part.class_name], vertices) < 0.004


def unplugged(monkeypatch, times: int):
    """Make a RealSense that is pulled after each frame and is away for some attempts."""
    state = {"frame": 0, "away": 0}

    def opened(settings):
        if state["away"]:
            state["away"] -= 1
            raise InputError("realsense: is not connected")
        for frame in frames(9):
            if int(frame.name) >= state["frame"]:
                state["frame"] += 1
                yield frame
                state["away"] = times
                raise InputError("realsense: librealsense stopped")

    monkeypatch.setattr(watching, "open_camera", opened)
    monkeypatch.setattr(watching, "_PAUSE", 0.0)


def test_frames_go_on_when_the_camera_is_back(monkeypatch, caplog) -> None:
    unplugged(monkeypatch, 2)
    camera = watching.steady_camera(CaptureSettings("realsense"))
    names = [next(camera).name for _ in range(3)]
    camera.close()
    assert names == ["000000", "000001", "000002"]
    assert [record.getMessage() for record in caplog.records] == [
        "realsense: librealsense stopped; frames go on when it is back"
    ] * 2


def test_a_camera_that_is_pulled_after_the_last_frame_is_not_waited_for(monkeypatch) -> None:
    unplugged(monkeypatch, 1)
    pauses = iter(range(3))
    monkeypatch.setattr(watching.time, "sleep", lambda _: next(pauses))
    settings = CaptureSettings("realsense", frames=2)
    assert [f.name for f in watching.steady_camera(settings)] == ["000000", "000001"]


def test_a_camera_that_never_gave_a_frame_is_refused(monkeypatch) -> None:
    def opened(settings):
        raise InputError("realsense: is not connected")
        yield

    monkeypatch.setattr(watching, "open_camera", opened)
    with pytest.raises(InputError, match="not connected"):
        next(watching.steady_camera(CaptureSettings("realsense")))


def assert_all_parts_are_seen(page, seen, library) -> None:
    """The first view of 75° holds all parts, and they fill at least a third of its height."""
    camera = page._server.initial_camera
    away = camera.look_at - camera.position
    ahead = away / np.linalg.norm(away)
    cads, farthest = {part.cad: part for part in library}, []
    for drawn in page.drawn:
        turn = Rotation.from_quat(np.roll(drawn.frame.wxyz, -1)).as_matrix()
        sights = cads[drawn.cad].points @ turn.T + drawn.frame.position - camera.position
        aside = np.linalg.norm(sights - np.outer(sights @ ahead, ahead), axis=1)
        farthest.append((aside / (sights @ ahead)).max())
        above = turn @ (np.array(drawn.label.position) - cads[drawn.cad].middle)
        np.testing.assert_allclose(above, (0, 0, cads[drawn.cad].diameter / 2), atol=1e-6)
    assert 1 / 3 < max(farthest) / np.tan(np.radians(75 / 2)) < 1


def test_the_page_stays_after_the_last_frame(typed, cad, shots, monkeypatch) -> None:
    pytest.importorskip("viser")
    pages, printed = [], []

    def waited() -> None:
        address = printed[0].split()[1]
        with urllib.request.urlopen(address, timeout=30) as got:  # noqa: S310
            pages.append(got.status)
        raise KeyboardInterrupt

    monkeypatch.setattr("qs3.report.view.wait", waited)
    monkeypatch.setattr("qs3.cli.watch.notify", lambda *lines: printed.extend(lines))
    camera = ("--units", "mm", "--camera", f"folder:{shots}", "--frames", 1, "--port", 0)
    assert len(typed("watch", cad, *camera).stdout.splitlines()) == 2
    assert pages == [200]
    assert printed[-1].startswith("The frames have ended; the page keeps the last one")
    typed("watch", cad, *camera, "--no-view")
    assert pages == [200]


def test_the_page_shows_cloud_parts_and_rate(library, tmp_path) -> None:
    pytest.importorskip("viser")
    from qs3.report.live import serve_live

    with serve_live(library, 0) as (address, page):
        seen = list(watching.watch_parts(library, frames(2), SegmentSettings()))
        page.show(seen[0])
        assert_all_parts_are_seen(page, seen[0], library)
        first = {drawn.cad: np.array(drawn.frame.position) for drawn in page.drawn}
        kept, found = list(page.drawn), seen[1].found
        other_way_round = replace(found, parts=found.parts[::-1])
        page.show(seen[1]._replace(found=other_way_round))
        assert page.drawn == kept  # nothing is drawn again
        page.show(seen[1])
        assert page.drawn == kept
        assert len(page.drawn) == 2
        ways = {d.cad: np.linalg.norm(d.frame.position - first[d.cad]) for d in page.drawn}
        assert ways["pin"] < 0.0015
        assert ways["bracket"] == pytest.approx(0.004, abs=0.0015)
        assert "bracket" in page.text.content
        assert "frames/s" in page.text.content
        for _ in range(40):
            page.show(seen[1]._replace(seconds=0.1))
        gone = seen[1]._replace(found=None, fault="no <depth>", seconds=1e-6)
        page.show(gone)
        assert ", 10.0 frames/s" in page.text.content
        assert "no &lt;depth&gt;" in page.text.content
        with urllib.request.urlopen(address, timeout=30) as got:  # noqa: S310
            assert got.status == 200
        browser = Browser(tmp_path / "profile")
        try:
            browser.open(address)
            until(lambda: "frames/s" in browser.run("document.body.innerText"))
            assert browser.run("document.querySelectorAll('canvas').length") >= 1
            assert browser.faults == []
        finally:
            browser.close()
