"""Output of the verbs: results on standard output, messages on standard error.

Names of files and classes come from others: characters that a terminal obeys, or that hide or turn
the text around, are written as escapes.
"""

import contextlib
import logging
import os
import shlex
import sys
import warnings
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from qs3.escapes import path_word
from qs3.escapes import printable as printable

_FEW = 5
"""Faults of single files that are printed before the last, if a table has them all."""
_format_warning = warnings.formatwarning
_UNREAD: set[Any] = set()
"""Streams whose reader went away; what is printed on them goes nowhere."""


def show(*lines: object, end: str = "\n") -> None:
    """Print results."""
    _print(sys.stdout, lines, end)


def notify(*lines: object) -> None:
    """Print messages: progress, the next command, faults."""
    _print(sys.stderr, lines, "\n")


def is_unread() -> bool:
    """Return whether the reader of the results went away (``qs3 … | head``)."""
    return sys.stdout in _UNREAD


def show_row(*cells: object) -> None:
    """Print results separated by tabs."""
    show("\t".join(printable(str(cell), keep="") for cell in cells))


def raise_last(faults: Sequence[object], total: int, what: str, table: Path | None = None) -> None:
    """Print the faults of single files; the last one is raised with their number.

    If a table has them all, few are printed.
    """
    from qs3.errors import InputError

    shown = faults[:-1] if table is None else faults[:-1][:_FEW]
    notify(*(f"qs3: {printable(str(fault), keep='')}" for fault in shown))
    if len(shown) < len(faults) - 1:
        notify(f"qs3: {len(faults) - 1 - len(shown)} more faults are in {table}")
    if faults:
        count = f" ({len(faults)} of {total} {what})" if total > 1 else ""
        raise InputError(f"{faults[-1]}{count}")


def quoted(path: object) -> str:
    """Quote a path for a shell; one that begins with - would be an option."""
    return shlex.quote(path_word(path))


def columns(rows: Sequence[Sequence[str]], right: int | None = None) -> list[str]:
    """Return the lines of a table; columns from ``right`` on are aligned right, as numbers are."""
    cells = [[printable(cell, keep="") for cell in row] for row in rows]
    widths = [max(map(len, column)) for column in zip(*cells, strict=True)]
    sides = ["<" if right is None or place < right else ">" for place in range(len(widths))]
    forms = [f"{{:{side}{width}}}" for side, width in zip(sides, widths, strict=True)]
    return ["  ".join(forms).format(*row).rstrip() for row in cells]


def prepare_streams() -> None:
    """Make output work with closed streams, other encodings and hostile names."""
    for name in ("stdin", "stdout", "stderr"):
        stream = getattr(sys, name)
        if stream is None:  # closed, as by 2>&-; opened in this order it takes the same number
            mode = "r" if name == "stdin" else "w"
            setattr(sys, name, Path(os.devnull).open(mode, encoding="utf-8"))  # noqa: SIM115
        elif name != "stdin" and hasattr(stream, "reconfigure"):
            stream.reconfigure(errors="backslashreplace")
    logging.lastResort = _Messages(logging.WARNING)
    warnings.formatwarning = _warning


class _Messages(logging.Handler):
    def emit(self, record: logging.LogRecord) -> None:
        try:
            notify(self.format(record))
        except OSError:
            self.handleError(record)


def _warning(message: Any, category: type[Warning], *place: Any, **named: Any) -> str:
    if category.__module__.startswith("qs3."):  # where in our code it arose helps nobody
        return printable(f"{message}\n")
    return printable(_format_warning(message, category, *place, **named))


def _print(stream: Any, lines: Sequence[object], end: str) -> None:
    bars: contextlib.AbstractContextManager[Any] = contextlib.nullcontext()
    if "tqdm" in sys.modules and (stream is sys.stderr or stream.isatty()):
        bars = sys.modules["tqdm"].tqdm.external_write_mode(stream)
    try:
        with bars:
            for line in lines:
                stream.write(printable(str(line)) + end)
            stream.flush()
    except OSError as error:
        # The rest of the buffer goes nowhere; else the end of the program fails again.
        os.dup2(os.open(os.devnull, os.O_WRONLY), stream.fileno())
        if isinstance(error, BrokenPipeError):  # `qs3 … | head`: the files are still to be written
            _UNREAD.add(stream)
            return
        error.filename = stream.name
        raise
