"""``qs3 watch``: the objects before a depth camera, frame by frame."""

import contextlib
import json
from pathlib import Path
from typing import Annotated

import tyro

from qs3.cli.options import Flat
from qs3.cli.text import show, show_row
from qs3.frames.cameras import CaptureSettings, open_camera
from qs3.objects.segment import SegmentSettings


def watch(
    run: Annotated[Path, tyro.conf.Positional],
    camera: Flat[CaptureSettings],
    settings: Flat[SegmentSettings] = SegmentSettings(noise=0.003),  # noqa: B008
    unknown: float | None = None,
    json_lines: Annotated[bool, tyro.conf.arg(name="json")] = False,
) -> int:
    """Print the objects before a depth camera, frame by frame, until Ctrl-C or its end.

    Args:
        run: Folder of a run, its model.safetensors, or a network that comes with qs3: rooms.
        camera: The camera, and which of its frames.
        settings: How a frame is cut into objects.
        unknown: Share of known objects that may be rejected as "unknown", as in qs3 predict.
        json_lines: Print a JSON line an object, with the probabilities of all classes, its box and,
            if the run has CAD, its pose.
    """
    from qs3.workflow import watch as watching

    with contextlib.suppress(KeyboardInterrupt):
        for frame in watching.watch(run, open_camera(camera), settings, unknown):
            if json_lines:
                show(*(json.dumps(row, ensure_ascii=False) for row in watching.rows(frame)))
                continue
            if frame.fault:
                show_row(frame.name, frame.fault)
            for item, answer in frame.objects:
                x, y, _ = item.centre
                said = answer.fault
                if not said:
                    ((label, share),) = answer.best()
                    said = f"{label} {share:.2f}"
                if answer.familiarity is not None:
                    said += f" familiarity {answer.familiarity:.2f}"
                if (found := answer.found) is not None:
                    said += f" {found.cad} residual {1000 * found.residual:.1f} mm"
                said += " lost" if answer.lost else ""
                show_row(frame.name, f"{said} at {x:.2f} {y:.2f}")
    return 0
