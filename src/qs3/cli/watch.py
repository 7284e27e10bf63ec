"""``qs3 watch``: the objects or the parts before a depth camera, frame by frame."""

import contextlib
import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import tyro
from jaxtyping import Float

from qs3.cli.options import Flat
from qs3.cli.text import is_unread, notify, show, show_row
from qs3.errors import InputError, MissingExtraError
from qs3.frames.cameras import CaptureSettings
from qs3.meshes.sizes import Unit
from qs3.objects.segment import SegmentSettings

if TYPE_CHECKING:
    from qs3.workflow.watch import SeenFrame, SeenParts


def watch(
    run: Annotated[Path, tyro.conf.Positional],
    camera: Flat[CaptureSettings],
    settings: Flat[SegmentSettings] = SegmentSettings(),  # noqa: B008
    unknown: float | None = None,
    units: Unit | None = None,
    least_score: float | None = None,
    base: Path | None = None,
    view: bool = True,
    port: int = 8080,
    json_lines: Annotated[bool, tyro.conf.arg(name="json")] = False,
) -> int:
    """Print the objects or parts before a depth camera, frame by frame.

    With CAD it finds each part and its pose as qs3 find does, follows it from frame to frame, and
    shows cloud and parts in a browser; after the last frame of a folder or a recording the page
    stays until Ctrl-C.
    Without CAD a network classifies each object on the table.
    A RealSense that is unplugged is opened again when it is back.

    Args:
        run: Folder of a run, its model.safetensors, or a network that comes with qs3: rooms. Or CAD
            alone: a folder of it, or a library that qs3 find --library wrote.
        camera: The camera, and which of its frames.
        settings: How a frame is cut into objects.
        unknown: Of a run without CAD: share of known objects that may be rejected as "unknown", as
            in qs3 predict.
        units: Unit of the CAD files, as in qs3 find.
        least_score: Parts of a lower score are left unexplained; a part of the last frame stays
            until its score falls below half of it. Default: 0.5.
        base: Text file of 4×4 numbers, base from camera: JSON lines also have poses from a robot's
            base.
        view: Show the parts in a browser; needs the extra view.
        port: Port of 127.0.0.1 for the browser; the next free one if it is in use.
        json_lines: Print one JSON line per part, with its pose and symmetry; or, without CAD, one
            per object, with the probabilities of all classes and its box.
    """
    from qs3.checks import check_numbers
    from qs3.workflow import watch as watching

    check_numbers("--port", port, 0, 65535)
    from_camera = None
    if base is not None:
        from qs3.parts.scenes.find_files import read_base  # it imports numba

        from_camera = read_base(base)
    library, frames = watching.library_of_run(run, units), watching.steady_camera(camera)
    with contextlib.ExitStack() as stack, contextlib.suppress(KeyboardInterrupt):
        if library is None:
            if base is not None or least_score is not None:
                word = "--base" if least_score is None else "--least-score"
                raise InputError(f"{word}: is of parts, and {run} is a run without CAD")
            for frame in watching.watch(run, frames, settings, unknown):
                _print_objects(frame, json_lines)
                if is_unread():
                    break
            return 0
        if unknown is not None:
            raise InputError("--unknown: is of runs without CAD; with CAD the rest is unexplained")
        page = None
        if view:
            from qs3.report.live import serve_live

            try:
                address, page = stack.enter_context(serve_live(library, port))
                notify(f"Open {address} in a browser; Ctrl-C ends it.")
            except MissingExtraError as error:
                notify(f"no page: {error}; or add --no-view")
        for seen in watching.watch_parts(library, frames, settings, least_score):
            _print_parts(seen, json_lines, from_camera)
            if is_unread():
                return 0
            if page is not None:
                page.show(seen)
        if page is not None:
            from qs3.report.view import wait

            notify("The frames have ended; the page keeps the last one. Ctrl-C ends it.")
            wait()
    return 0


def _print_parts(seen: "SeenParts", as_json: bool, base: Float[np.ndarray, "4 4"] | None) -> None:
    from qs3.cli.find import show_parts
    from qs3.workflow.watch import part_rows

    if as_json:
        show(*(json.dumps(row) for row in part_rows(seen, base)))
    elif seen.found is None:
        show_row(seen.frame.name, seen.fault)
    else:
        show_parts(seen.frame.name, seen.found)


def _print_objects(frame: "SeenFrame", as_json: bool) -> None:
    from qs3.workflow.watch import rows

    if as_json:
        show(*(json.dumps(row) for row in rows(frame)))
        return
    if frame.fault:
        show_row(frame.name, frame.fault)
    for item, answer in frame.objects:
        x, y, _ = item.centre
        text = answer.fault
        if not text:
            ((label, share),) = answer.best()
            text = f"{label} {share:.2f}"
        if answer.familiarity is not None:
            text += f" familiarity {answer.familiarity:.2f}"
        show_row(frame.name, f"{text} at {x:.2f} {y:.2f}")
