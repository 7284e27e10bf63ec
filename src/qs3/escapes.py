"""Text of others, written so that a terminal shows it and obeys nothing in it."""

import csv
import io
import re
import unicodedata
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

_OBEYED = {"Cc", "Cf", "Cs", "Zl", "Zp"}
"""Categories of Unicode: control, format (turns of direction), surrogates, breaks of lines."""


def printable(text: str, keep: str = "\n\t") -> str:
    """Write control characters, but those to ``keep``, and what cannot be encoded as escapes."""
    return "".join(
        letter
        if letter in keep or unicodedata.category(letter) not in _OBEYED
        else letter.encode("unicode_escape").decode()
        for letter in text
    )


def utf8(name: str) -> str:
    """Return the name of a file, with bytes that are not UTF-8 as escapes."""
    return name.encode("utf-8", errors="backslashreplace").decode("utf-8")


_FORMULA = re.compile(r"\s*[-+=@]")


def cell(value: Any) -> Any:
    """Return a value as a cell of a CSV, which no spreadsheet computes and no terminal obeys.

    Text that begins as a formula gets an apostrophe; numbers stay numbers.
    """
    if not isinstance(value, str):
        return value
    text = printable(value, keep="")
    if not _FORMULA.match(value):
        return text
    try:
        float(text)
    except ValueError:
        return f"'{text}"
    return text


def plain(text: str) -> str:
    """Return text of `cell` without the apostrophe."""
    return text[1:] if text[:1] == "'" and _FORMULA.match(text[1:]) else text


def csv_text(heads: Sequence[str], rows: Iterable[Mapping[str, Any]]) -> str:
    """Return a CSV of rows, each value a `cell`."""
    buffer = io.StringIO()
    table = csv.DictWriter(buffer, list(heads))
    table.writeheader()
    for row in rows:
        table.writerow({name: cell(value) for name, value in row.items()})
    return buffer.getvalue()
