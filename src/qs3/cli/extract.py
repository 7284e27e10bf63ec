"""``qs3 extract``: objects out of real scans, into a data set."""

from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import tyro

from qs3.cli.capture import capture
from qs3.cli.options import Flat
from qs3.cli.store import refuse_failures
from qs3.cli.text import quoted, show, tell
from qs3.io.cameras.frames import CaptureSettings, FrameSettings
from qs3.io.extract.depth import extract_depth
from qs3.io.extract.nyuv2 import extract_nyuv2
from qs3.io.extract.run import ExtractReport, OutputSettings
from qs3.io.extract.scannet import extract_scannet


def _verb(function: Callable[..., ExtractReport]) -> Callable[..., int]:
    """One of the library's functions as a verb: its settings are the options, its text the help."""
    kind: Any = get_type_hints(function)["settings"]

    def verb(
        source: Annotated[Path, tyro.conf.Positional],
        output: Flat[OutputSettings],
        settings: Flat[kind],  # pyright: ignore[reportInvalidTypeForm]
    ) -> int:
        return _tell(output.out, function(source, output, settings))

    verb.__doc__ = (function.__doc__ or "").partition("Raises:")[0]
    return verb


def _bag(
    source: Annotated[Path, tyro.conf.Positional],
    out: Path,
    settings: Flat[FrameSettings] = FrameSettings(),  # noqa: B008
) -> int:
    """Write the frames of a RealSense's recording as files.

    Args:
        source: The recording: .bag, or .db3 of later versions.
        out: New folder for depth/, color/, intrinsics.json and times.csv.
        settings: Which of its frames.
    """
    return capture(CaptureSettings(f"bag:{source}", **asdict(settings)), out)


def _rosbag(
    source: Annotated[Path, tyro.conf.Positional],
    out: Path,
    topic: str = "",
    intrinsics: str = "",
    settings: Flat[FrameSettings] = FrameSettings(),  # noqa: B008
) -> int:
    """Write the depth images of a recording of ROS 1 or ROS 2 as files.

    Args:
        source: A .bag of ROS 1; of ROS 2 the folder with metadata.yaml, a .db3 or a .mcap.
        out: New folder for depth/, intrinsics.json and times.csv.
        topic: Topic of the depth images, if there are several.
        intrinsics: If the bag has no CameraInfo: fx,fy,cx,cy or a file.
        settings: Which of its frames.
    """
    camera = CaptureSettings(f"rosbag:{source}", intrinsics, topic, **asdict(settings))
    return capture(camera, out)


extract: dict[str, Callable[..., int]] = {
    "scannet": _verb(extract_scannet),
    "nyuv2": _verb(extract_nyuv2),
    "depth": _verb(extract_depth),
    "bag": _bag,
    "rosbag": _rosbag,
}
"""The sources of the verb, by name."""


def _tell(out: str, report: ExtractReport) -> int:
    """Tell what was done and what comes next; failures are an error."""
    from qs3.store.failures import read_failures

    if report.axes:
        tell(f"clouds in the axes of the {report.axes}")
    show(out)
    left = ""
    if report.planned is not None:
        fewer = f"had fewer than {report.min_points} points"
        left = f" of {report.planned}, {report.planned - report.objects} {fewer}"
        if report.failed:
            left = f" of {report.planned}, the others failed or {fewer}"
    tell(
        f"{report.objects} objects{left}; {report.units} frames or scenes done, {report.skipped} "
        f"were there before, {report.failed} failed. Next: qs3 train --method qbst --source DATA "
        f"--target {quoted(out)} --out RUN"
    )
    refuse_failures(out, read_failures(out), "scenes or frames")
    return 0
