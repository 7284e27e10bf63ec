"""``qs3 extract``: objects out of real scans, into a data set."""

from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, get_type_hints

import tyro

from qs3.cli.options import Flat
from qs3.cli.text import notify, quoted, show
from qs3.errors import InputError
from qs3.objects.depth import extract_depth
from qs3.objects.run import ExtractReport, OutputSettings
from qs3.paper.data.nyuv2 import extract_nyuv2
from qs3.paper.data.scannet import extract_scannet


def _verb(function: Callable[..., ExtractReport]) -> Callable[..., int]:
    """One of the library's functions as a verb: its settings are the options, its text the help."""
    kind: Any = get_type_hints(function)["settings"]

    def verb(
        source: Annotated[
            Path,
            tyro.conf.Positional,
            tyro.conf.arg(help="Folder or file of the real scans, as downloaded or recorded."),
        ],
        output: Flat[OutputSettings],
        settings: Flat[kind],  # pyright: ignore[reportInvalidTypeForm]
    ) -> int:
        return _show_counts(output.out, function(source, output, settings))

    text = function.__doc__ or ""
    verb.__doc__ = text.partition("Convention:")[0].partition("Raises:")[0]
    return verb


extract: dict[str, Callable[..., int]] = {
    "scannet": _verb(extract_scannet),
    "nyuv2": _verb(extract_nyuv2),
    "depth": _verb(extract_depth),
}
"""The sources of the verb, by name."""


def _show_counts(out: str, report: ExtractReport) -> int:
    """Print what was done and what comes next; failures are an error."""
    from qs3.store.manifest import refuse_failures

    if report.axes:
        notify(f"clouds in the axes of the {report.axes}")
    following = ""
    if report.objects:
        show(out)
        following = f" Next: qs3 train --method qbst --source DATA --target {quoted(out)} --out RUN"
    left = ""
    if report.planned is not None:
        fewer = f"had fewer than {report.min_points} points"
        left = f" of {report.planned}, {report.planned - report.objects} {fewer}"
        if report.failed:
            left = f" of {report.planned}, the others failed or {fewer}"
    notify(
        f"{report.objects} objects{left}; {report.units} frames or scenes done, {report.skipped} "
        f"were there before, {report.failed} failed.{following}"
    )
    refuse_failures(out, "scenes or frames")
    if not report.objects:
        raise InputError(
            f"{out}: no object was found: wrong classes, or none of {report.min_points} points; "
            "name a new folder for other settings"
        )
    return 0
