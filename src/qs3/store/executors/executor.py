"""Protocol of the executors, and the result of a call that failed."""

from collections.abc import Callable, Iterable, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

from qs3.errors import InputError, StorageError


@dataclass(frozen=True)
class Failure:
    """A call that failed."""

    kind: str
    """Class of the exception, ``ProcessDied`` or ``Timeout``."""
    reason: str
    fatal: bool = False
    """Whether every other call must fail the same way: a package is missing, the disk is full."""


@runtime_checkable
class Executor(AbstractContextManager["Executor"], Protocol):
    """Runs picklable calls somewhere; on exit it stops at once whatever still runs.

    Up to ``ahead`` calls are submitted before the first is done. ``next`` waits for any call to
    end, and returns its key, and its value or a `Failure`.
    """

    @property
    def ahead(self) -> int: ...  # noqa: D102

    def submit(self, key: Any, function: Callable[..., Any], *arguments: Any) -> None: ...  # noqa: D102

    def next(self) -> tuple[Any, Any]: ...  # noqa: D102


def outcomes(executor: Executor, calls: Iterable[tuple[Any, ...]]) -> Iterator[tuple[Any, Any]]:
    """Keep an entered executor busy; yield key and outcome of each call, as they end.

    ``calls`` are key, function and arguments. Raises InputError if one failed as all must.
    """
    left, under_way = iter(calls), 0
    while True:
        while under_way < executor.ahead and (call := next(left, None)) is not None:
            executor.submit(*call)
            under_way += 1
        if not under_way:
            return
        key, outcome = executor.next()
        under_way -= 1
        if isinstance(outcome, Failure) and outcome.fatal:  # every other call would share it
            raise InputError(outcome.reason)
        yield key, outcome


def guarded(function: Callable[..., Any], *arguments: Any) -> Any:
    """Call a function; return a `Failure` in place of an exception, which may not pickle."""
    try:
        return function(*arguments)
    except Exception as error:
        reason = (str(error).strip().splitlines() or [""])[0]
        return Failure(type(error).__name__, reason, isinstance(error, ImportError | StorageError))


class InlineExecutor(AbstractContextManager["InlineExecutor"]):
    """Does one call after another here, where a crash or a hang of one ends or hangs all."""

    ahead = 1

    def submit(self, key: Any, function: Callable[..., Any], *arguments: Any) -> None:
        """Keep the call for `next`."""
        self._call = key, function, arguments

    def next(self) -> tuple[Any, Any]:
        """Do the call."""
        key, function, arguments = self._call
        return key, guarded(function, *arguments)

    def __exit__(self, *exception: object) -> None:
        return None
