"""``qs3 report``: one self-contained page about a run, several runs, or records."""

import shlex
import sys
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Annotated, Literal

import tyro

from qs3.errors import InputError


@dataclass(frozen=True)
class ReportOptions:
    """Write one page about a finished run, a folder of runs, or a folder of records."""

    folder: Annotated[Path, tyro.conf.Positional]
    """Folder of a run, of several runs, or of records alone."""
    data: str | None = None
    """Labelled clouds to score and to look at; by default those that the record names, if they
    still lie near the run. Their labels serve the page only."""
    split: str | None = None
    """Part of the data, such as test."""
    cloud: Literal["points", "clean", "surface"] | None = None
    """Of generated data: the cloud to score; by default that of the record or of the run."""
    source: str | None = None
    """Labelled clouds of the source to look at; by default those that the run read."""
    source_split: str | None = None
    """Part of the source."""
    source_cloud: Literal["points", "clean", "surface"] | None = None
    """Of a generated source: the cloud to look at; by default that which the run read."""
    run: Path | None = None
    """Of several runs the one to tell about in full; by default the first qs3 or qbst, else the
    first that was adapted, else the first."""
    before: Path | None = None
    """Run to compare with; by default the warm-up, or the source-only run of the same settings."""
    mesh: str = "chair"
    """Mesh file or built-in class whose scan is shown step by step; none leaves it out."""
    sensor: str = "paper"
    """Preset of the sensor for that scan, or your own TOML file."""
    clouds: int = 200
    """Clouds to step through, half of them of each domain."""
    out: Path | None = None
    """The page; report.html in the folder by default."""


def report(options: Annotated[ReportOptions, tyro.conf.arg(name="")]) -> int:
    """Write one self-contained HTML page: pictures, clouds to turn, features, scores, tables."""
    from qs3.cli.report_page import make_page
    from qs3.cli.report_runs import look
    from qs3.report import write_report

    out = options.folder / "report.html" if options.out is None else options.out
    if options.clouds < 0:
        raise InputError(f"--clouds {options.clouds}: must not be negative")
    for name in ("data", "source"):
        parts = ("split", "cloud") if name == "data" else ("source_split", "source_cloud")
        for part in parts:
            if getattr(options, name) is None and getattr(options, part) is not None:
                raise InputError(f"{_flag(part)} goes with --{name}; name the clouds")
    if out.is_dir():
        raise InputError(f"{out}: is a folder; name a file for --out")
    contents = look(options.folder)
    page, faults = make_page(options, contents)
    faults = (*contents.faults, *faults)
    for fault in faults:
        print(f"qs3: left out: {fault}", file=sys.stderr)
    verdict = write_report(out, page)
    print(out)
    if verdict is not None:
        print(verdict.text.partition(": ")[0], file=sys.stderr)
    size = out.stat().st_size / 1e6
    print(f"{size:.1f} MB, one file. Open it in a browser.", file=sys.stderr)
    return 1 if faults else 0


def command_of(options: ReportOptions) -> str:
    """The command that makes the page again, with paths as given.

    Of an absolute path or an address the last part alone is told: the page is passed on, and what
    lies above is nobody else's business. ``--out`` changes nothing on the page and is left out.

    Example:
        >>> command_of(ReportOptions(Path("runs"), data="/home/me/my scans", clouds=20))
        "qs3 report runs --data 'my scans' --clouds 20"
    """
    words = ["qs3", "report", _as_given(options.folder)]
    for one in fields(options):
        value = getattr(options, one.name)
        if one.name not in ("folder", "out") and value != one.default:
            words += [_flag(one.name), _as_given(value)]
    return shlex.join(words)


def _as_given(value: object) -> str:
    text = str(value)
    hidden = "://" in text or Path(text).is_absolute()
    return Path(text).name if hidden else text


def _flag(name: str) -> str:
    return "--" + name.replace("_", "-")
