"""Progress bars on the standard error stream: rate and time left."""

import sys
from collections.abc import Iterable
from typing import Any

from tqdm import tqdm

from qs3.escapes import printable

_MANY, _COMPARED = 500, 50
_IN_A_LOG = 10.0  # seconds between two lines of a log file


def cloud_bar(items: Iterable[Any] | None, text: str, count: int) -> "tqdm[Any]":
    """Return a bar over clouds; hidden for 500 or fewer, and outside a terminal."""
    return tqdm(items, text, count, unit="cloud", disable=None if count > _MANY else True)


def compared_bar(items: Iterable[Any], count: int) -> "tqdm[Any]":
    """Return a bar over scans that are compared with CAD; hidden for 50 or fewer."""
    text = "compare with CAD" if count > _COMPARED else None
    return progress_bar(count, text, "scan", items=items)


def progress_bar(
    total: int | None,
    text: str | None,
    unit: str,
    initial: int = 0,
    items: Iterable[Any] | None = None,
) -> "tqdm[Any]":
    """Return a bar, hidden if ``text`` is None; a ``total`` of None counts only."""
    text = text and printable(text, keep="")  # a folder's name may move a terminal
    every = 0.1 if sys.stderr.isatty() else _IN_A_LOG
    return tqdm(items, text, total, unit=unit, initial=initial, mininterval=every, disable=not text)
