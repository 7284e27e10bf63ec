"""``qs3 table`` and ``qs3 figure``: a table or a figure of the records that are there."""

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, get_args

import tyro

from qs3.errors import InputError
from qs3.experiments.catalogue import FigureFormat, TableFormat, TableName

if TYPE_CHECKING:
    from qs3.experiments.paper import PaperTable

_FIGURES: Mapping[str, FigureFormat] = {f".{kind}": kind for kind in get_args(FigureFormat)}
INCOMPLETE = 1
"""Exit code where a record was refused and the rest is shown."""


@dataclass(frozen=True)
class TableOptions:
    """Print a table from records; cells without runs show the command that makes them."""

    name: Annotated[TableName, tyro.conf.Positional]
    """Which table."""
    results: Annotated[Path, tyro.conf.Positional]
    """Folder that qs3 reproduce made, or such a one as lies in results/ of the source."""
    format: TableFormat = "md"
    """Markdown, CSV (a line a run) or LaTeX."""


@dataclass(frozen=True)
class FigureOptions:
    """Draw a figure from records."""

    name: Annotated[TableName, tyro.conf.Positional]
    """Which figure."""
    results: Annotated[Path, tyro.conf.Positional]
    """Folder that qs3 reproduce made, or such a one as lies in results/ of the source."""
    out: Path
    """File to write."""
    format: FigureFormat | None = None
    """Pixels or vectors; by default what the name of the file says."""


def table(options: Annotated[TableOptions, tyro.conf.arg(name="")]) -> int:
    """Print a table of the paper, ours beside the published figures, from records alone."""
    part = _part(options.name, options.results)
    grid, faults = part.grid()
    print(part.text(grid, options.format))
    return _tell(faults)


def figure(options: Annotated[FigureOptions, tyro.conf.arg(name="")]) -> int:
    """Draw a figure of the paper from records alone."""
    from qs3.files import write_bytes

    if options.out.is_dir():
        raise InputError(f"--out {options.out}: is a folder; name a file")
    kind = _FIGURES.get(options.out.suffix.lower())
    if kind is None or options.format not in (None, kind):
        wanted = " or ".join(_FIGURES) if options.format is None else f".{options.format}"
        raise InputError(f"--out {options.out}: must end in {wanted}")
    part = _part(options.name, options.results)
    grid, faults = part.grid()
    write_bytes(options.out, part.picture(grid, kind))
    print(options.out)
    return _tell(faults)


def _tell(faults: list[str]) -> int:
    for fault in faults:
        print(f"qs3: refused: {fault}", file=sys.stderr)
    return INCOMPLETE if faults else 0


def _part(name: str, folder: Path) -> "PaperTable":
    from qs3.experiments.paper import EXPERIMENTS, PaperTable
    from qs3.experiments.setup import read_setup

    setup = read_setup(folder)
    return PaperTable(EXPERIMENTS[name], setup)
