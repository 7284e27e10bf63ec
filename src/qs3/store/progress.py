"""One kind of progress bar: rate and time left, on the standard error stream."""

import sys
from collections.abc import Iterable
from typing import Any

from tqdm import tqdm

from qs3.escapes import printable

_MANY = 500
_IN_A_LOG = 10.0  # seconds between two lines where nobody watches


def cloud_bar(
    items: Iterable[Any] | None, text: str, count: int, shown: bool = True
) -> "tqdm[Any]":
    """Return a bar over clouds; there is none for few of them, nor where nobody watches."""
    hidden = None if shown and count > _MANY else True
    return tqdm(items, text, count, unit="cloud", disable=hidden)


def progress_bar(
    total: int | None,
    text: str | None,
    unit: str,
    initial: int = 0,
    items: Iterable[Any] | None = None,
) -> "tqdm[Any]":
    """Return a bar; ``text`` None shows none. In a log file it writes every ten seconds at most.

    It is moved by hand, or by going through it where it has ``items``; ``total`` None tells a count
    alone.
    """
    if text is not None:  # it begins with a folder's name, which may move a terminal
        text = printable(text, keep="")
    return tqdm(
        items,
        total=total,
        initial=initial,
        desc=text,
        disable=text is None,
        unit=unit,
        mininterval=0.1 if sys.stderr.isatty() else _IN_A_LOG,
    )
