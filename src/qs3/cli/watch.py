"""``qs3 watch``: what stands before a camera, frame by frame."""

import contextlib
import json
from collections.abc import Iterator
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from qs3.cli.options import Flat
from qs3.cli.text import printable, show, tell
from qs3.io.cameras.frames import CaptureSettings, open_camera
from qs3.io.extract.segment import SegmentSettings

if TYPE_CHECKING:
    from qs3.viewer.live import Live


def watch(
    run: Annotated[Path, tyro.conf.Positional],
    camera: Flat[CaptureSettings],
    settings: Flat[SegmentSettings] = SegmentSettings(stride=2, noise=0.003),  # noqa: B008
    unknown: float | None = None,
    json_lines: Annotated[bool, tyro.conf.arg(name="json")] = False,
    view: bool = False,
    port: int = 8080,
) -> int:
    """Tell what stands before a depth camera, frame by frame, until Ctrl-C or its end.

    Args:
        run: Folder of a run, its model.safetensors, or a network that comes with qs3: rooms.
        camera: Which camera, and which of its frames.
        settings: How a frame is cut into objects.
        unknown: Share of the objects of its own classes that the network may answer by "unknown",
            as in qs3 predict.
        json_lines: Print a line of JSON a frame, with every class's probability and the boxes.
        view: Show the objects in a browser on this machine too (extra view).
        port: Port of 127.0.0.1 for that; 0 takes a free one.
    """
    from qs3.training import watch as watching

    rate = watching.Rate()
    with contextlib.suppress(KeyboardInterrupt), contextlib.ExitStack() as stack:
        page = stack.enter_context(_page(str(run), port)) if view else None
        for frame in watching.watch(run, open_camera(camera, colour=False), settings, unknown):
            rate.add(frame)
            if page is not None:
                page.show(frame, str(rate))
            if json_lines:
                show(json.dumps(watching.plain(frame), ensure_ascii=False))
                continue
            objects = []
            for item, answer in frame.objects:
                ((name, share),), (x, y, _) = answer.best(), item.centre
                objects.append(f"{printable(name, keep='')} {share:.2f} at {x:.2f} {y:.2f}")
            show(f"{printable(frame.name, keep='')}\t{', '.join(objects) or frame.fault}")
    if str(rate):
        tell(str(rate))
    return 0


@contextlib.contextmanager
def _page(run: str, port: int) -> "Iterator[Live]":
    from qs3.viewer.live import Live
    from qs3.viewer.serving import serve, url_of

    with serve(port, f"qs3 watch · {Path(run).name}") as server:
        tell(f"open {url_of(server)} in a browser")
        yield Live(server)
