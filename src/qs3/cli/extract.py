"""``qs3 extract``: objects out of real scans, into a data set."""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated

import tyro

from qs3.cli.options import Flat
from qs3.cli.store import refuse_failures
from qs3.cli.text import show, tell
from qs3.io.extract.depth import DepthImageSettings, extract_depth
from qs3.io.extract.run import ExtractReport, OutputSettings
from qs3.io.extract.scannet import ScanNetSettings, extract_scannet
from qs3.io.extract.sunrgbd import SunRgbdSettings, extract_sunrgbd

_Source = Annotated[Path, tyro.conf.Positional]


def scannet(
    root: _Source,
    output: Flat[OutputSettings],
    settings: Flat[ScanNetSettings] = ScanNetSettings(),  # noqa: B008
) -> int:
    """Cut objects from ScanNet: fused from its raw depth frames, or from its meshes.

    Args:
        root: A copy of the release, its folder scans, or one scene's folder.
        output: Where the clouds go.
        settings: What is cut.
    """
    return _tell(output.out, extract_scannet(root, output, settings))


def sunrgbd(
    root: _Source,
    output: Flat[OutputSettings],
    settings: Flat[SunRgbdSettings] = SunRgbdSettings(),  # noqa: B008
) -> int:
    """Cut objects from SUN RGB-D by its oriented boxes.

    Args:
        root: The folder SUNRGBD of the release, or the one above it.
        output: Where the clouds go.
        settings: What is cut.
    """
    return _tell(output.out, extract_sunrgbd(root, output, settings))


def depth(
    source: _Source,
    output: Flat[OutputSettings],
    settings: Flat[DepthImageSettings] = DepthImageSettings(),  # noqa: B008
) -> int:
    """Cut objects from depth images of any camera, or from scenes in BOP's layout.

    Args:
        source: A depth image (16-bit PNG, TIFF, npy), a folder of them, or a scene in BOP's layout
            or a folder of such scenes, such as the frames/ of qs3 scan --frames.
        output: Where the clouds go.
        settings: What is cut.
    """
    return _tell(output.out, extract_depth(source, output, settings))


extract: dict[str, Callable[..., int]] = {"scannet": scannet, "sunrgbd": sunrgbd, "depth": depth}
"""The sources of the verb, by name."""


def _tell(out: str, report: ExtractReport) -> int:
    """Tell what was done and what comes next; failures are an error."""
    from qs3.store.failures import read_failures

    if report.axes:
        tell(f"clouds in the axes of the {report.axes}")
    show(out)
    left = ""
    if report.planned is not None and not report.failed:
        fewer = report.planned - report.objects
        left = f" of {report.planned}, {fewer} had fewer than {report.min_points} points"
    tell(
        f"{report.objects} objects{left}; {report.units} frames or scenes done, {report.skipped} "
        f"were there before, {report.failed} failed. Next: qs3 train --method qbst --source DATA "
        f"--target {out} --out RUN"
    )
    refuse_failures(out, read_failures(out), "scenes or frames")
    return 0
