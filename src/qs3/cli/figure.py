"""``qs3 figure``: the figure of a table, of the records that are there."""

from pathlib import Path
from typing import get_args

from qs3.cli.options import Flat
from qs3.cli.table import TableOptions, refused
from qs3.cli.text import show
from qs3.errors import InputError
from qs3.paper import FigureFormat


def figure(options: Flat[TableOptions], out: Path) -> int:
    """Draw the figure of a table from records alone: of views, thresholds or growth.

    Args:
        options: Which one.
        out: File to write; its name ends in .png or .svg.
    """
    kinds: dict[str, FigureFormat] = {f".{kind}": kind for kind in get_args(FigureFormat)}
    kind = kinds.get(out.suffix.lower())
    if kind is None:
        raise InputError(f"--out {out}: must be a file that ends in {' or '.join(kinds)}")
    from qs3.files import check_output, write_bytes
    from qs3.paper.figures import picture
    from qs3.report.figure import check_picture

    check_output(out, "--out", out.suffix.lower())
    check_picture(out)
    chosen = options.choose()
    write_bytes(out, picture(chosen, kind))
    show(out)
    return refused(chosen)
