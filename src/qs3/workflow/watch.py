"""Objects and parts in the frames of a depth camera, one frame after another."""

import logging
import time
from collections.abc import Generator, Sequence
from contextlib import closing
from dataclasses import asdict, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from jaxtyping import Float

from qs3.answers.answer import Answer, answer, load_trained
from qs3.answers.cloud_files import ListedCloud
from qs3.errors import InputError
from qs3.frames.cameras import Camera, CaptureSettings, DepthFrame, open_camera
from qs3.meshes.sizes import Unit
from qs3.objects.scene_files import lift_scene, seen_table
from qs3.objects.segment import SegmentedObject, SegmentSettings, segment
from qs3.parts import LIBRARY
from qs3.runs.bundled import find_run, not_a_run
from qs3.runs.loaded import Loaded
from qs3.runs.run import FOREST, MODEL, is_run, weights_file

if TYPE_CHECKING:
    from qs3.parts import FoundParts, Library

_log = logging.getLogger(__name__)
_PAUSE = 1.0
"""Seconds from one attempt to open a camera that was unplugged to the next."""
_AGAIN = 30
"""Frames after which what no part explains, and a table that may be a side of a part, is searched
again, though it did not change."""


class SeenFrame(NamedTuple):
    """The objects of a frame and their answers."""

    name: str
    timestamp: float | None
    """Seconds, by the camera's clock."""
    objects: tuple[tuple[SegmentedObject, Answer], ...]
    fault: str = ""


class SeenParts(NamedTuple):
    """The parts in a frame."""

    frame: DepthFrame
    found: "FoundParts | None"
    """None if the frame has a fault."""
    seconds: float
    fault: str = ""


def watch_parts(
    library: "Library",
    camera: Camera,
    settings: SegmentSettings,
    least_score: float | None = None,
) -> Generator[SeenParts, None, None]:
    """Yield the parts before a camera, frame by frame; closing it closes the camera.

    A part of the last frame is refined from its pose, and only the rest is searched. ``settings``
    are those of the table; without a gap it is that of `qs3.parts.find`, and so is a
    ``least_score`` of None. A frame without a table is searched without one, as by `find`.
    """
    from qs3.parts.scenes.finding import find_cut
    from qs3.parts.scenes.found import GAP, FindSettings

    settings = replace(settings, gap=settings.gap or GAP)
    finding = FindSettings(min_points=settings.min_points)
    if least_score is not None:
        finding = replace(finding, least_score=least_score)
    last: FoundParts | None = None
    with closing(camera):
        for number, frame in enumerate(camera):
            start, found, fault = time.perf_counter(), None, ""
            if last is not None and number % _AGAIN == 0:
                last = replace(last, unexplained=(), side=None)
            try:
                last = found = find_cut(
                    library, frame.depth, frame.camera, settings, finding, before=last
                )
            except InputError as error:  # a hand before the lens
                fault = str(error)
            yield SeenParts(frame, found, time.perf_counter() - start, fault)


def steady_camera(settings: CaptureSettings) -> Camera:
    """Yield the frames of a camera; a RealSense that is unplugged between them is opened again.

    A camera that never gave a frame raises `InputError`, and so does the fault of a recording or a
    folder.
    """
    count, is_lost = 0, False
    live = settings.camera.partition(":")[0] == "realsense"
    while True:
        left = None if settings.frames is None else settings.frames - count
        try:
            with closing(open_camera(replace(settings, frames=left))) as camera:
                for frame in camera:
                    count, is_lost = count + 1, False
                    yield frame
            return
        except InputError as error:
            if count == settings.frames:
                return
            if not live or not count:
                raise
            if not is_lost:
                _log.warning("%s; frames go on when it is back", error)
            is_lost = True
        time.sleep(_PAUSE)


def watch(
    run: str | Path, camera: Camera, settings: SegmentSettings, unknown: float | None = None
) -> Generator[SeenFrame, None, None]:
    """Yield the objects before a camera, frame by frame; closing it closes the camera.

    A frame is cut as `qs3.objects.scene_files.segment_scene` cuts a depth image; ``unknown`` is as
    in `qs3.answers.answer.answer`.
    """
    loaded = load_trained(Path(run))
    if unknown is not None:
        loaded.require_known(run, unknown)
    with closing(camera):
        for frame in camera:
            items, fault = [], ""
            try:
                scene = lift_scene(frame.depth, frame.camera, settings, frame.name)
                items = segment(scene, settings, seen_table(scene, settings))
            except InputError as error:  # an empty table, a hand before the lens
                fault = str(error)
            objects = predict_objects(loaded, items, unknown)
            yield SeenFrame(frame.name, frame.timestamp, objects, fault)


def predict_objects(
    loaded: Loaded, items: Sequence[SegmentedObject], unknown: float | None = None
) -> tuple[tuple[SegmentedObject, Answer], ...]:
    """Classify the objects of a frame; ``unknown`` is as in `qs3.answers.answer.answer`.

    CAD of the run is not compared: it finds parts in the whole frame (`watch_parts`).
    """
    clouds = (ListedCloud(Path(f"object_{i:03d}"), item.points) for i, item in enumerate(items))
    return tuple(zip(items, answer(loaded, clouds, unknown=unknown, pose=False), strict=True))


def library_of_run(run: str | Path, units: Unit | None = None) -> "Library | None":
    """Return the CAD of a run, of a library's file, or of a folder of CAD; None of a network.

    Raises:
        InputError: If there is no such run, and for ``units`` of a run.
    """
    place = find_run(run)
    home = place.parent if place.name in (MODEL, FOREST) else place
    has_cad = (home / LIBRARY).is_file()
    if not has_cad and home.is_dir() and (is_run(home) or weights_file(home) is not None):
        if units is not None:
            raise InputError(f"--units {units}: is of CAD files, and {run} is a run without CAD")
        return None
    if not place.exists():
        raise InputError(f"{run}: {not_a_run(place)}")
    from qs3.parts.locate_files import library_of  # it imports numba

    return library_of(home, units)


def part_rows(
    seen: SeenParts, base: Float[np.ndarray, "4 4"] | None = None
) -> list[dict[str, Any]]:
    """Return a plain mapping for each part and each rest that no CAD explains, or with the fault.

    Lengths are in metres; a pose is camera from part. ``base`` is the pose base from camera: each
    part then also has ``base_from_part``.
    """
    from qs3.parts.library import UNEXPLAINED
    from qs3.parts.scenes.find_files import part_record

    head = {"frame": seen.frame.name, "time": seen.frame.timestamp, "seconds": seen.seconds}
    if seen.found is None:
        return [head | {"fault": seen.fault}]
    parts = [head | part_record(part, base) for part in seen.found.parts]
    rest = [head | {"class": UNEXPLAINED} | asdict(piece) for piece in seen.found.unexplained]
    return parts + rest


def rows(frame: SeenFrame) -> list[dict[str, Any]]:
    """Return a plain mapping for each object, or one with the fault; lengths in metres."""
    head = {"frame": frame.name, "time": frame.timestamp}
    if frame.fault:
        return [head | {"fault": frame.fault}]
    lines = []
    for item, prediction in frame.objects:
        box = {"centre": item.centre, "size": item.size, "heading": item.heading}
        row: dict[str, Any] = head | {"fault": prediction.fault}
        if not prediction.fault:
            ((label, share),) = prediction.best()
            row = head | {"class": label, "confidence": share}
        if prediction.familiarity is not None:
            row["familiarity"] = prediction.familiarity
        row |= {"points": len(item.points)} | box
        lines.append(row if prediction.fault else row | {"probabilities": prediction.probabilities})
    return lines
