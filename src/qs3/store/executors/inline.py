"""Calls done in this process, one after another: for debugging, and for cheap calls."""

import collections
from collections.abc import Callable
from typing import Any

from qs3.store.executors.executor import guarded


class InlineExecutor:
    """Does each call when its outcome is asked for. A crash or a hang of one ends or hangs all."""

    ahead = 1

    def __init__(self) -> None:
        self._waiting: collections.deque[tuple[Any, Callable[..., Any], tuple[Any, ...]]] = (
            collections.deque()
        )

    def submit(self, key: Any, function: Callable[..., Any], *arguments: Any) -> None:
        """Keep a call for `next`."""
        self._waiting.append((key, function, arguments))

    def next(self) -> tuple[Any, Any]:
        """Do the oldest call."""
        key, function, arguments = self._waiting.popleft()
        return key, guarded(function, *arguments)

    def drain(self) -> list[tuple[Any, Any]]:
        """Drop the calls that wait; none is under way."""
        self._waiting.clear()
        return []

    def __enter__(self) -> "InlineExecutor":
        """Return itself."""
        return self

    def __exit__(self, *exception: object) -> None:
        """Drop what waits."""
        self.drain()
