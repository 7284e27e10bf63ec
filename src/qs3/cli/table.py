"""``qs3 table``: a table of the records that are there."""

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from qs3.cli.options import Flat
from qs3.cli.text import notify, show
from qs3.paper import TABLES, TableFormat

if TYPE_CHECKING:
    from qs3.paper.table import Table

INCOMPLETE = 1
"""Exit code if a record was refused and the rest is shown."""
TableName = str
if not TYPE_CHECKING:
    TableName = tyro.extras.literal_type_from_choices(TABLES)


@dataclass(frozen=True)
class TableOptions:
    """A table, and the folder of its records."""

    name: Annotated[TableName, tyro.conf.Positional]
    """Name of the table."""
    results: Annotated[Path, tyro.conf.Positional]
    """Folder that qs3 reproduce made, or one like results/laptop of the source."""
    methods: tuple[str, ...] = ()
    """Lines; all by default."""
    tasks: tuple[str, ...] = ()
    """Columns, such as S-D; the usual ones by default."""

    def choose(self) -> "Table":
        """Return the table."""
        from qs3.paper.setup import read_setup
        from qs3.paper.table import Table

        return Table(self.name, read_setup(self.results), self.methods, self.tasks)


def table(options: Flat[TableOptions], format: TableFormat = "md") -> int:
    """Print a table, ours beside the published figures, from records alone.

    Cells without runs show the command that makes them.

    Args:
        options: Which one.
        format: Markdown, CSV (a line per run) or LaTeX.
    """
    from qs3.paper.table_text import FORMATS, markdown

    chosen = options.choose()
    show(markdown(chosen, whole_paths=True) if format == "md" else FORMATS[format](chosen))
    return refused(chosen)


def refused(table: "Table") -> int:
    """Report refused records; return the exit code."""
    for fault in table.faults:
        notify(f"qs3: refused: {fault}")
    return INCOMPLETE if table.faults else 0
