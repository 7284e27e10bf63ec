"""``qs3 report``: one self-contained page about a run, several runs, or records."""

import shlex
from collections.abc import Mapping
from dataclasses import fields, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from qs3.cli.options import Flat
from qs3.cli.text import show, tell
from qs3.errors import InputError, QS3Error
from qs3.report.settings import ReportSettings

if TYPE_CHECKING:
    from qs3.report.contents import Report
    from qs3.training.run import Run


def report(
    folder: Annotated[Path, tyro.conf.Positional],
    settings: Flat[ReportSettings] = ReportSettings(),  # noqa: B008
    mesh: str = "",
    sensor: str = "",
    out: Path | None = None,
) -> int:
    """Write one self-contained HTML page.

    It holds pictures of a scan, clouds to turn, curves, features, scores and tables.

    Args:
        folder: Folder of a run, of several runs, or of records alone.
        settings: What to tell.
        mesh: Mesh file or built-in class whose scan is shown step by step; none leaves it out. By
            default the first of the run's own source that lies near it, else the built-in chair.
        sensor: Preset of the sensor for that scan, or your own TOML file; by default that of the
            source, else paper.
        out: The page; report.html in the folder by default.
    """
    from qs3.report.collect import collect, look, told_run
    from qs3.report.page import write_report
    from qs3.training.shipped import workplace

    out = workplace(folder) / "report.html" if out is None else out
    if out.is_dir():
        raise InputError(f"{out}: is a folder; name a file for --out")
    published, source = _published()
    holdings = look(folder, published)
    tell("scoring, laying out features …")
    page, faults = collect(holdings, settings)
    tell(*(f"qs3: left out: {fault}" for fault in faults))
    command = command_of(folder, settings, mesh, sensor)
    page = replace(page, command=command, published_source=source)
    verdict = write_report(
        out,
        page if mesh == "none" else _with_scan(page, told_run(holdings, settings), mesh, sensor),
    )
    show(out)
    if verdict is not None:
        tell(verdict.opening)
    tell(f"{out.stat().st_size / 1e6:.1f} MB, one file. Open it in a browser.")
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


def _with_scan(page: "Report", told: "Run | None", name: str, sensor: str) -> "Report":
    """Add a scan step by step, or a note where none can be made here."""
    from qs3.meshes.collections import load_named
    from qs3.report.lookup import find_mesh
    from qs3.report.montage import montage_view
    from qs3.sensor.scan import ScanSettings, scan

    own = None if told is None else find_mesh(told)
    settings = ScanSettings() if own is None else own.settings
    if own is not None and not name:
        mesh, title = own.mesh, own.name
    else:
        mesh, origin = load_named(name or "chair", 0)
        title = origin["name"]
    if sensor:
        settings = replace(settings, sensor=sensor)
    if not (made := settings.make_sensor()).metric:  # a bad one is refused
        settings = replace(settings, object_size=None)
    settings = replace(settings, sensor=made, views=2)
    try:
        settings = replace(settings, renderer=settings.make_renderer())
    except QS3Error as error:
        tell(f"no scan can be made here: {error}")
        note = "No renderer works where this page was made: no scan is shown."
        return replace(page, notes=(*page.notes, note))
    tell("scanning for the pictures …")
    view, _ = montage_view(scan(mesh, settings, keep_images=True))
    return replace(page, montage=view, montage_title=f"{title} · sensor {made.name}")


def command_of(folder: Path, settings: ReportSettings, mesh: str = "", sensor: str = "") -> str:
    """The command that makes the page again, with paths as given.

    Of an absolute path or an address the last part alone is told: the page is passed on, and what
    lies above is nobody else's business.

    Example:
        >>> command_of(Path("runs"), ReportSettings(data="/home/me/my scans", clouds=20))
        "qs3 report runs --data 'my scans' --clouds 20"
    """
    words = ["qs3", "report", _as_given(folder)]
    values = {f.name: (getattr(settings, f.name), f.default) for f in fields(settings)}
    values |= {"mesh": (mesh, ""), "sensor": (sensor, "")}
    for name, (value, default) in values.items():
        if value != default:
            words += ["--" + name.replace("_", "-"), _as_given(value)]
    return shlex.join(words)


def _as_given(value: Any) -> str:
    text = str(value)
    hidden = "://" in text or Path(text).is_absolute()
    return Path(text).name if hidden else text
