"""Frames of a depth camera cut into objects, and what a network says of each."""

import time
from collections.abc import Generator, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any, NamedTuple

from qs3.errors import InputError
from qs3.io.cameras.frames import Camera
from qs3.io.extract.segment import SegmentedObject, SegmentSettings, lift_scene, segment
from qs3.io.preparation import LARGEST, stack
from qs3.training.answers import Answer, answer_clouds
from qs3.training.checkpoint import LoadedModel, load_model

_DENSER = 4
"""Of an object so many times the points of the network count; strays take longer in more."""

STAGES = ("read", "segment", "predict")


class SeenObject(NamedTuple):
    """An object on the table and what the network says of it."""

    item: SegmentedObject
    """Its points and its box."""
    answer: Answer
    """What the network says of it."""


class SeenFrame(NamedTuple):
    """What was seen in a frame."""

    name: str
    """The frame's."""
    timestamp: float | None
    """Seconds, by the camera's clock."""
    objects: tuple[SeenObject, ...]
    """The largest first."""
    seconds: tuple[float, float, float]
    """That reading, segmenting and predicting took."""
    fault: str = ""
    """Why there is no object."""


def watch(
    run: str | Path, camera: Camera, settings: SegmentSettings, unknown: float | None = None
) -> Generator[SeenFrame, None, None]:
    """Yield what stands before a camera, frame by frame; closing it closes the camera.

    Args:
        run: Folder of a run, its model.safetensors, or the name of a network that comes with qs3.
        camera: Gives the frames.
        settings: How a frame is cut into objects.
        unknown: As in `predict_objects`.

    Raises:
        InputError: where the run or the camera cannot be read, or the run does not hold what is
            known to it.
    """
    loaded = load_model(Path(run))
    if unknown is not None:
        loaded.require_known(run, unknown)
    with closing(camera):
        while True:
            begin = time.perf_counter()
            frame = next(camera, None)
            if frame is None:
                return
            read, fault = time.perf_counter(), ""
            try:
                items = segment(
                    lift_scene(frame.depth, frame.camera, settings, frame.name), settings
                )
            except InputError as error:  # an empty table, a hand before the lens
                items, fault = [], str(error)
            cut = time.perf_counter()
            objects = predict_objects(loaded, items, unknown)
            end = time.perf_counter()
            yield SeenFrame(
                frame.name, frame.timestamp, objects, (read - begin, cut - read, end - cut), fault
            )


def predict_objects(
    loaded: LoadedModel, items: Sequence[SegmentedObject], unknown: float | None = None
) -> tuple[SeenObject, ...]:
    """Tell the class of each object of a frame, all in one pass.

    Args:
        loaded: The network.
        items: The objects.
        unknown: Share of objects of the known classes that may be refused; None always answers.
    """
    if not items:
        return ()
    most = min(LARGEST, _DENSER * (loaded.num_points or LARGEST))
    clouds = stack([item.points for item in items], None, "frame", most)
    return tuple(map(SeenObject, items, answer_clouds(loaded, clouds, unknown)))


def plain(frame: SeenFrame) -> dict[str, Any]:
    """A frame as plain values, for JSON; lengths in metres."""
    objects = []
    for item, answer in frame.objects:
        ((name, share),) = answer.best()
        box = {"centre": item.centre, "size": item.size, "heading": item.heading}
        fields = {"class": name, "confidence": share, "points": len(item.points), **box}
        objects.append(fields | {"probabilities": answer.probabilities})
    seconds = dict(zip(STAGES, frame.seconds, strict=True))
    line = {"frame": frame.name, "time": frame.timestamp, "objects": objects, "seconds": seconds}
    return line | ({"fault": frame.fault} if frame.fault else {})


class Rate:
    """How many frames a second, and the mean time of each stage."""

    def __init__(self) -> None:
        self._frames, self._timed, self._sums = 0, 0, [0.0, 0.0, 0.0]

    def add(self, frame: SeenFrame) -> None:
        """Count a frame."""
        self._frames += 1
        if self._frames == 2:  # what the first one loads, the others find there
            self._timed, self._sums = 0, [0.0, 0.0, 0.0]
        self._timed += 1
        self._sums = [total + part for total, part in zip(self._sums, frame.seconds, strict=True)]

    def __str__(self) -> str:
        """A line; nothing before the first frame."""
        if not self._frames:
            return ""
        means = [part / self._timed for part in self._sums]
        parts = ", ".join(
            f"{name} {1000 * mean:.0f} ms" for name, mean in zip(STAGES, means, strict=True)
        )
        return f"{self._frames} frames, {1 / sum(means):.1f} a second; of each: {parts}"
