"""What every executor does, and what a task that did not end well hands back."""

import collections
import errno
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any, Protocol, runtime_checkable

from qs3.errors import InputError, StorageError

# Not of one object: a full or lost disk, a mount that went away, no more open files.
_MACHINE_IS_AT_FAULT = (
    *(errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EROFS, errno.EIO),
    *(errno.ESTALE, errno.ENOTCONN, errno.EMFILE, errno.ENFILE),
)
_TOO_MANY_KILLED = 5


@dataclass(frozen=True)
class Failure:
    """A task that did not end well."""

    kind: str
    """Class of the exception, ``ProcessDied``, ``Killed`` (from outside) or ``Timeout``."""
    reason: str
    """Its message, one line."""
    fatal: bool = False
    """Whether every other task must fail the same way: a package is missing, the disk is full."""


@runtime_checkable
class Executor(Protocol):
    """Runs calls somewhere. Used by one thread, as a context manager."""

    @property
    def ahead(self) -> int:
        """Tasks worth handing over before the first is done."""
        ...

    def submit(self, key: Any, function: Callable[..., Any], *arguments: Any) -> None:
        """Hand over a call; ``key`` comes back with its outcome. All must be picklable."""
        ...

    def next(self) -> tuple[Any, Any]:
        """Wait for any call to end: its key, and its value or a `Failure`."""
        ...

    def drain(self) -> list[tuple[Any, Any]]:
        """Let the calls under way end and drop those that wait; what ended, as `next` gives it."""
        ...

    def __enter__(self) -> "Executor":
        """Start."""
        ...

    def __exit__(self, *exception: object) -> None:
        """Stop at once whatever still runs."""
        ...


def outcomes(
    executor: Executor,
    next_call: Callable[[], tuple[Any, ...] | None],
    name_of: Callable[[Any], str] = str,
) -> Iterator[tuple[Any, Any]]:
    """Keep an executor busy; yield key and outcome of each call, as they end.

    A call whose processes were killed from outside is not yielded: that is no fault of its own.

    Args:
        executor: Entered already.
        next_call: Returns key, function and arguments of one more call, or None where there is
            none at this moment; asked again after every outcome.
        name_of: Turns a key into the name of what the call works on.

    Raises:
        InputError: where a call failed as every other must; and in the end, or after five, where
            calls were killed.
    """
    under_way, killed = 0, list[str]()
    while True:
        while under_way < executor.ahead and (call := next_call()) is not None:
            executor.submit(*call)
            under_way += 1
        if not under_way or len(killed) == _TOO_MANY_KILLED:
            break
        key, outcome = executor.next()
        under_way -= 1
        stop_if_fatal(outcome)
        if isinstance(outcome, Failure) and outcome.kind == "Killed":
            killed.append(f"{name_of(key)}: {outcome.reason}")
        else:
            yield key, outcome
    if killed:
        raise InputError(
            f"this machine could not make {len(killed)}, the first {killed[0]}; give it more "
            "memory or fewer workers and run the same command again, nothing else is lost"
        )


def guarded(function: Callable[..., Any], *arguments: Any) -> Any:
    """Call, and turn an exception into a value; it would not survive pickling with any certainty.

    Example:
        >>> guarded(int, "x").kind
        'ValueError'
    """
    try:
        return function(*arguments)
    except Exception as error:
        return failure_of(error)


def failure_of(error: Exception) -> Failure:
    """Tell a fault of one object from one that no other task will be spared."""
    reason = (str(error).strip().splitlines() or [""])[0]
    fatal = isinstance(error, ImportError | StorageError)
    if isinstance(error, OSError) and error.errno in _MACHINE_IS_AT_FAULT:
        fatal, reason = True, error.strerror or reason
    return Failure(type(error).__name__, reason, fatal)


def stop_if_fatal(outcome: Any) -> None:
    """Raise what no other task will be spared.

    Raises:
        InputError: with the reason.
    """
    if isinstance(outcome, Failure) and outcome.fatal:
        raise InputError(outcome.reason)


class InlineExecutor:
    """Does each call in this process when its outcome is asked for: for debugging, and cheap calls.

    A crash or a hang of one ends or hangs all.
    """

    ahead = 1

    def __init__(self) -> None:
        self._waiting: collections.deque[tuple[Any, ...]] = collections.deque()

    def submit(self, key: Any, function: Callable[..., Any], *arguments: Any) -> None:
        """Keep a call for `next`."""
        self._waiting.append((key, function, *arguments))

    def next(self) -> tuple[Any, Any]:
        """Do the oldest call."""
        key, *call = self._waiting.popleft()
        return key, guarded(*call)

    def drain(self) -> list[tuple[Any, Any]]:
        """Drop the calls that wait; none is under way."""
        self._waiting.clear()
        return []

    def __enter__(self) -> "InlineExecutor":
        return self

    def __exit__(self, *exception: object) -> None:
        self.drain()
