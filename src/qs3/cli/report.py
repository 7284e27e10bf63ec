"""``qs3 report``: one self-contained page about a run, several runs, or records."""

import shlex
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from qs3.errors import InputError, QS3Error
from qs3.report.settings import ReportSettings

if TYPE_CHECKING:
    from qs3.report.contents import Report


@dataclass(frozen=True)
class ReportOptions:
    """Write one page about a finished run, a folder of runs, or a folder of records."""

    folder: Annotated[Path, tyro.conf.Positional]
    """Folder of a run, of several runs, or of records alone."""
    settings: Annotated[ReportSettings, tyro.conf.arg(name="")] = field(
        default_factory=ReportSettings
    )
    """What to tell."""
    mesh: str = "chair"
    """Mesh file or built-in class whose scan is shown step by step; none leaves it out."""
    sensor: str = "paper"
    """Preset of the sensor for that scan, or your own TOML file."""
    out: Path | None = None
    """The page; report.html in the folder by default."""


def report(options: Annotated[ReportOptions, tyro.conf.arg(name="")]) -> int:
    """Write one self-contained HTML page: pictures, clouds to turn, features, scores, tables."""
    from qs3.report.collect import collect, look
    from qs3.report.page import write_report

    out = options.folder / "report.html" if options.out is None else options.out
    if out.is_dir():
        raise InputError(f"{out}: is a folder; name a file for --out")
    options.settings.require_sound()
    published, source = _published()
    holdings = look(options.folder, published)
    print("scoring, laying out features …", file=sys.stderr)
    page, faults = collect(holdings, options.settings)
    for fault in faults:
        print(f"qs3: left out: {fault}", file=sys.stderr)
    page = replace(page, command=command_of(options), published_source=source)
    verdict = write_report(out, _with_scan(page, options))
    print(out)
    if verdict is not None:
        print(verdict.opening, file=sys.stderr)
    size = out.stat().st_size / 1e6
    print(f"{size:.1f} MB, one file. Open it in a browser.", file=sys.stderr)
    return 1 if faults else 0


def _published() -> tuple[dict[str, dict[str, str]], str]:
    """The paper's accuracies by task and row as text, and where they were printed."""
    from qs3.experiments.experiment import published

    figures = published()["methods"]
    tasks = {
        task: {
            row: f"{value[0]:.1f} ± {value[1]:.1f}"
            for row, value in rows.items()
            if isinstance(value, list) and len(value) == 2
        }
        for task, rows in figures.items()
        if isinstance(rows, Mapping)
    }
    return tasks, figures["source"]


def _with_scan(page: "Report", options: ReportOptions) -> "Report":
    """Add a scan step by step, or a note where none can be made here."""
    from qs3.meshes.named import load_named
    from qs3.report.montage import scan_montage
    from qs3.sensor.settings import CameraSettings

    if options.mesh == "none":
        return page
    mesh, origin = load_named(options.mesh, 0)
    camera = CameraSettings(sensor=options.sensor)
    sensor = camera.make_sensor()
    try:
        renderer = camera.make_renderer()
    except QS3Error as error:
        print(f"no scan can be made here: {error}", file=sys.stderr)
        note = "No renderer works where this page was made: no scan is shown."
        return replace(page, notes=(*page.notes, note))
    print("scanning for the pictures …", file=sys.stderr)
    title = f"{origin['name']} · sensor {options.sensor}"
    return replace(page, montage=scan_montage(mesh, sensor, renderer), montage_title=title)


def command_of(options: ReportOptions) -> str:
    """The command that makes the page again, with paths as given.

    Of an absolute path or an address the last part alone is told: the page is passed on, and what
    lies above is nobody else's business. ``--out`` changes nothing on the page and is left out.

    Example:
        >>> given = ReportSettings(data="/home/me/my scans", clouds=20)
        >>> command_of(ReportOptions(Path("runs"), given))
        "qs3 report runs --data 'my scans' --clouds 20"
    """
    words = ["qs3", "report", _as_given(options.folder)]
    values = [(f, getattr(options.settings, f.name)) for f in fields(ReportSettings)]
    values += [
        (f, getattr(options, f.name)) for f in fields(options) if f.name in ("mesh", "sensor")
    ]
    for setting, value in values:
        if value != setting.default:
            words += ["--" + setting.name.replace("_", "-"), _as_given(value)]
    return shlex.join(words)


def _as_given(value: Any) -> str:
    text = str(value)
    hidden = "://" in text or Path(text).is_absolute()
    return Path(text).name if hidden else text
