"""What ``qs3 extract`` does with its options: run, tell what was done and what comes next."""

import dataclasses
import sys
from typing import Any

from qs3.cli.extract import DepthOptions, OutOptions, ScanNetOptions, SunOptions
from qs3.errors import InputError
from qs3.io.extract.cut import CutSettings
from qs3.io.extract.run import ExtractReport, OutputSettings


def depth(options: DepthOptions) -> int:
    """Cut objects from depth images or scenes in BOP's layout."""
    from qs3.io.extract.depth import DepthImageSettings, extract_depth

    settings = _settings(DepthImageSettings, options)
    return _tell(options.output, extract_depth(options.source, _output(options), settings))


def sunrgbd(options: SunOptions) -> int:
    """Cut objects from SUN RGB-D."""
    from qs3.io.extract.sunrgbd import SunRgbdSettings, extract_sunrgbd

    settings = _settings(SunRgbdSettings, options)
    return _tell(options.output, extract_sunrgbd(options.root, _output(options), settings))


def scannet(options: ScanNetOptions) -> int:
    """Cut objects from ScanNet."""
    from qs3.io.extract.scannet import ScanNetSettings, extract_scannet

    settings = _settings(ScanNetSettings, options)
    return _tell(options.output, extract_scannet(options.root, _output(options), settings))


def _output(options: Any) -> OutputSettings:
    return OutputSettings(**vars(options.output))


def _settings(kind: Any, options: Any) -> Any:
    names = {field.name for field in dataclasses.fields(kind)}
    values = {name: value for name, value in vars(options).items() if name in names}
    if dataclasses.is_dataclass(values.get("cut")):
        values["cut"] = CutSettings(**vars(values["cut"]))
    return kind(**values)


def _tell(output: OutOptions, report: ExtractReport) -> int:
    """Tell what was done and what comes next; failures are an error."""
    from qs3.store.failures import FAILURES, read_failures

    if report.axes:
        print(f"clouds in the axes of the {report.axes}", file=sys.stderr)
    print(output.out)
    left = ""
    if report.planned is not None and not report.failed:
        fewer = report.planned - report.objects
        left = f" of {report.planned}, {fewer} had fewer than {report.min_points} points"
    print(
        f"{report.objects} objects{left}; {report.units} frames or scenes done, {report.skipped} "
        f"were there before, {report.failed} failed. Next: qs3 train --method qbst --source DATA "
        f"--target {output.out} --out RUN",
        file=sys.stderr,
    )
    if report.failed:
        first = read_failures(output.out)[0]
        raise InputError(
            f"{output.out}/{FAILURES}: {report.failed} failed; the first: {first['id']}: "
            f"{first['reason']}; all others are there, --retry-failed does these again"
        )
    return 0
