"""Cut the frames of a depth camera into objects and classify each."""

import math
from collections.abc import Generator, Sequence
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from qs3.answers.answer import Answer, answer, pose_values
from qs3.answers.listing import ListedCloud
from qs3.answers.loading import Trained, load_trained
from qs3.errors import InputError
from qs3.frames.cameras import Camera
from qs3.objects.scenes import lift_scene, seen_table
from qs3.objects.segment import SegmentedObject, SegmentSettings, segment
from qs3.parts.loaded import LoadedForest

if TYPE_CHECKING:
    from qs3.parts.locating import Place


class SeenFrame(NamedTuple):
    """The objects of a frame and their answers."""

    name: str
    timestamp: float | None
    """Seconds, by the camera's clock."""
    objects: tuple[tuple[SegmentedObject, Answer], ...]
    fault: str = ""


def watch(
    run: str | Path, camera: Camera, settings: SegmentSettings, unknown: float | None = None
) -> Generator[SeenFrame, None, None]:
    """Yield the objects before a camera, frame by frame; closing it closes the camera.

    A frame is cut as `qs3.objects.scenes.segment_scene` cuts a depth image. Takes the arguments
    of `predict_objects`.
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
    loaded: Trained, items: Sequence[SegmentedObject], unknown: float | None = None
) -> tuple[tuple[SegmentedObject, Answer], ...]:
    """Answer the objects of a frame; ``unknown`` is as in `qs3.answers.answer.answer`."""
    has_cad = isinstance(loaded, LoadedForest) and loaded.cad is not None
    places = [_place_of(item) if has_cad else None for item in items]
    clouds = (
        ListedCloud(Path(f"object_{number:03d}"), item.points, place=place)
        for number, (item, place) in enumerate(zip(items, places, strict=True))
    )
    return tuple(zip(items, answer(loaded, clouds, unknown=unknown), strict=True))


def _place_of(item: SegmentedObject) -> "Place":
    """Return what the table and the camera over the origin say about an object."""
    from qs3.parts.locating import Place  # it imports numba

    height = item.distance * math.sin(math.radians(item.elevation)) + item.centre[2]
    return Place(True, (0.0, 0.0, height) if height > 0 else None)


def rows(frame: SeenFrame) -> list[dict[str, Any]]:
    """Return a plain mapping for each object, or one with the fault; lengths in metres.

    A pose is from the CAD file to the axes of the objects: z up from the table, the camera over the
    origin.
    """
    head = {"frame": frame.name, "time": frame.timestamp}
    if frame.fault:
        return [head | {"fault": frame.fault}]
    lines = []
    for item, given in frame.objects:
        box = {"centre": item.centre, "size": item.size, "heading": item.heading}
        answered: dict[str, Any] = {"fault": given.fault}
        if not given.fault:
            ((label, share),) = given.best()
            answered = {"class": label, "confidence": share}
        if given.familiarity is not None:
            answered["familiarity"] = given.familiarity
        answered |= pose_values(given)
        row = head | answered | {"points": len(item.points)} | box
        lines.append(row if given.fault else row | {"probabilities": given.probabilities})
    return lines
