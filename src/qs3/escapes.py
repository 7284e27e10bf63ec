"""Text of others, written so that a terminal shows it and obeys nothing in it."""

import contextlib
import csv
import io
import json
import os
import re
import unicodedata
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

_OBEYED = {"Cc", "Cf", "Cs", "Zl", "Zp"}
"""Categories of Unicode: control, format (turns of direction), surrogates, breaks of lines."""
_JOINERS = "\u200c\u200d"
"""Of category Cf, but part of how Persian, Hindi and emoji are spelt; no terminal obeys them."""
_ESCAPE = re.compile(r"\\(?:[nrt]|x[0-9a-f]{2}|u[0-9a-f]{4}|U[0-9a-f]{8})")


def printable(text: str, keep: str = "\n\t") -> str:
    """Write control characters, but those to ``keep``, and what cannot be encoded as escapes."""
    return "".join(
        letter.encode("unicode_escape").decode() if _is_obeyed(letter, keep) else letter
        for letter in text
    )


def path_word(path: object) -> str:
    """Return a path as a word of a command; one that begins with - would be an option."""
    text = str(path)
    return f"./{text}" if text.startswith("-") else text


def is_printable(text: str) -> bool:
    """Return whether each character shows, or joins two that do; spaces alone break words."""
    return "".join(letter for letter in text if letter not in _JOINERS).isprintable()


def nfc(text: str) -> str:
    """Return text in Unicode's composed form: macOS hands out names of files decomposed."""
    return unicodedata.normalize("NFC", text)


def find_file(path: Path) -> Path | None:
    """Return a file, or the one whose path differs in Unicode's form alone; None if none is there.

    A file of exactly the given name comes first.
    """
    if os.path.isfile(path):  # noqa: PTH113 (takes names that are too long)
        return path
    if path.as_posix().isascii():
        return None
    found = [Path(path.anchor)]
    for part in path.parts[bool(path.anchor) :]:
        inside = [place / part for place in found if part == ".."]
        for place in found:
            with contextlib.suppress(OSError):
                inside += [
                    entry for entry in sorted(place.iterdir()) if nfc(entry.name) == nfc(part)
                ]
        found = inside
    return next((place for place in found if place.is_file()), None)


def _is_obeyed(letter: str, keep: str = "") -> bool:
    return letter not in keep + _JOINERS and unicodedata.category(letter) in _OBEYED


def utf8(name: str) -> str:
    """Return the name of a file, with bytes that are not UTF-8 as escapes."""
    return name.encode("utf-8", errors="backslashreplace").decode("utf-8")


_FORMULA = re.compile(r"'*\s*[-+=@]")


def cell(value: Any) -> Any:
    """Return a value as a cell of a CSV, which no spreadsheet computes and no terminal obeys.

    Text that begins as a formula gets an apostrophe; numbers stay numbers, also several with spaces
    between them.

    Example:
        >>> cell("-0.5 1 2"), cell("-1+2")
        ('-0.5 1 2', "'-1+2")
    """
    if not isinstance(value, str):
        return value
    text = printable(value, keep="")
    if not _FORMULA.match(value):
        return text
    try:
        [float(word) for word in text.split()]
    except ValueError:
        return f"'{text}"
    return text


def plain(text: str) -> str:
    """Return text of `cell` without the apostrophe."""
    return text[1:] if text[:1] == "'" and _FORMULA.match(text[1:]) else text


def unescaped(text: str) -> str:
    """Return text of `printable` with its escapes undone.

    Example:
        >>> unescaped(printable("a\u200eb", keep="")) == "a\u200eb"
        True
    """

    def letter(match: re.Match[str]) -> str:
        meant = match[0].encode().decode("unicode_escape")
        return meant if _is_obeyed(meant) else match[0]

    return _ESCAPE.sub(letter, text)


def csv_text(heads: Sequence[str], rows: Iterable[Mapping[str, Any]]) -> str:
    """Return a CSV of rows, each value a `cell`."""
    buffer = io.StringIO()
    table = csv.DictWriter(buffer, list(heads))
    table.writeheader()
    for row in rows:
        table.writerow({name: cell(value) for name, value in row.items()})
    return buffer.getvalue()


def json_text(rows: Sequence[Mapping[str, Any]]) -> str:
    """Return a JSON list in ASCII, which moves no terminal; numbers that are not finite raise."""
    return f"{json.dumps(rows, indent=2, allow_nan=False)}\n"
