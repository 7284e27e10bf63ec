"""``qs3 capture``: frames of a depth camera, live or recorded, as files."""

import contextlib
from pathlib import Path

from qs3.cli.options import Flat
from qs3.cli.text import notify, quoted, show
from qs3.frames.cameras import CaptureSettings, open_camera
from qs3.frames.folder import capture as write_frames
from qs3.frames.images import DEPTH, list_images


def capture(settings: Flat[CaptureSettings], out: Path) -> int:
    """Write the frames of a depth camera, live or recorded, as files, until Ctrl-C or the end.

    Args:
        settings: Which camera, and which of its frames.
        out: New folder for depth/, intrinsics.json and times.csv.
    """
    with contextlib.suppress(KeyboardInterrupt):
        write_frames(open_camera(settings), out)
    count = len(list_images(out / DEPTH)) if (out / DEPTH).is_dir() else 0
    show(out)
    notify(f"{count} frames. Next: qs3 find CAD {quoted(out)}; "
         f"qs3 segment {quoted(out)} --out OBJECTS; "
         f"qs3 watch RUN --camera {quoted(f'folder:{out}')}")  # fmt: skip
    return 0
