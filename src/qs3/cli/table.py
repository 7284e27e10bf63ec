"""``qs3 table`` and ``qs3 figure``: a table or a figure of the records that are there."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, get_args

import tyro

from qs3.cli.options import Flat
from qs3.cli.text import show, tell
from qs3.errors import InputError
from qs3.experiments import TABLES, FigureFormat, TableFormat

if TYPE_CHECKING:
    from qs3.experiments.table import Table

INCOMPLETE = 1
"""Exit code where a record was refused and the rest is shown."""
TableName = str
if not TYPE_CHECKING:
    TableName = tyro.extras.literal_type_from_choices(TABLES)


@dataclass(frozen=True)
class TableOptions:
    """Which table, of which records."""

    name: Annotated[TableName, tyro.conf.Positional]
    """Which one."""
    results: Annotated[Path, tyro.conf.Positional]
    """Folder that qs3 reproduce made, or one like results/laptop of the source."""
    methods: tuple[str, ...] = ()
    """Lines; all by default."""
    tasks: tuple[str, ...] = ()
    """Columns, such as S-D; the usual ones by default."""

    def choose(self) -> "Table":
        """Return the table."""
        from qs3.experiments.setup import read_setup
        from qs3.experiments.table import Table

        return Table(self.name, read_setup(self.results), self.methods, self.tasks)


def table(options: Flat[TableOptions], format: TableFormat = "md") -> int:
    """Print a table, ours beside the published figures, from records alone.

    Cells without runs show the command that makes them.

    Args:
        options: Which one.
        format: Markdown, CSV (a line a run) or LaTeX.
    """
    from qs3.experiments.text import FORMATS

    chosen = options.choose()
    show(FORMATS[format](chosen))
    return _refused(chosen)


def figure(options: Flat[TableOptions], out: Path) -> int:
    """Draw the figure of a table from records alone.

    Args:
        options: Which one.
        out: File to write; its name ends in .png or .svg.
    """
    kinds: dict[str, FigureFormat] = {f".{kind}": kind for kind in get_args(FigureFormat)}
    kind = kinds.get(out.suffix.lower())
    if kind is None:
        raise InputError(f"--out {out}: must be a file that ends in {' or '.join(kinds)}")
    from qs3.experiments.figures import picture
    from qs3.files import check_output, write_bytes

    check_output(out, "--out", out.suffix.lower())
    chosen = options.choose()
    write_bytes(out, picture(chosen, kind))
    show(out)
    return _refused(chosen)


def _refused(table: "Table") -> int:
    for fault in table.faults:
        tell(f"qs3: refused: {fault}")
    return INCOMPLETE if table.faults else 0
