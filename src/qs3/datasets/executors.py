"""Run a function over a list of tasks in this process or in several, results in order."""

import collections
import contextlib
import multiprocessing
import signal
from collections.abc import Callable, Generator, Sequence
from concurrent.futures import Future, ProcessPoolExecutor
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from typing import Any

from tqdm import tqdm

from qs3.errors import InputError

_Ahead = collections.deque[tuple[int, Future[Any]]]


@dataclass(frozen=True)
class Failure:
    """A task that did not end well."""

    kind: str
    """Class of the exception, or ``ProcessDied``."""
    reason: str
    """Its message, one line."""
    fatal: bool = False
    """Whether every other task must fail the same way: a package is missing."""


def run_ordered(
    function: Callable[[Any], Any],
    tasks: Sequence[Any],
    *,
    workers: int = 1,
    progress: str | None = None,
) -> Generator[Any, None, None]:
    """Yield ``function(task)`` for each task in order, or a `Failure` in its place.

    A task that takes its process down with it (a crash in native code, no memory) fails alone:
    the pool is made anew, and the tasks that were under way run again one at a time.

    Args:
        function: A picklable function; one process keeps what it caches between tasks.
        tasks: Picklable arguments.
        workers: Processes, started afresh (spawn); 1 runs everything here.
        progress: Text before a bar on the standard error stream; None shows none.

    Raises:
        InputError: where a package is missing or no worker process can start.
    """
    run = _run_here(function, tasks) if workers == 1 else _run_pool(function, tasks, workers)
    failed = 0
    bar = tqdm(total=len(tasks), desc=progress, disable=progress is None, unit="scan")
    with bar, contextlib.closing(run):
        for result in run:
            if isinstance(result, Failure):
                if result.fatal:
                    raise InputError(result.reason)
                failed += 1
                bar.set_postfix(failed=failed, refresh=False)
            bar.update()
            yield result


def _guarded(function: Callable[[Any], Any], task: Any) -> Any:
    """Turn an exception into a value; it would not survive pickling with any certainty."""
    try:
        return function(task)
    except Exception as error:
        lines = str(error).strip().splitlines()
        return Failure(
            kind=type(error).__name__,
            reason=lines[0] if lines else "",
            fatal=isinstance(error, ImportError),
        )


def _run_here(function: Callable[[Any], Any], tasks: Sequence[Any]) -> Generator[Any, None, None]:
    for task in tasks:
        yield _guarded(function, task)


def _run_pool(
    function: Callable[[Any], Any], tasks: Sequence[Any], workers: int
) -> Generator[Any, None, None]:
    pool = _pool(workers)
    next_task = 0
    ahead: _Ahead = collections.deque()
    try:
        while next_task < len(tasks) or ahead:
            try:
                # A few tasks ahead keep the workers busy without holding many results.
                while next_task < len(tasks) and len(ahead) < 4 * workers:
                    future = _submit(pool, _guarded, function, tasks[next_task])
                    ahead.append((next_task, future))
                    next_task += 1
                result = ahead[0][1].result()
            except BrokenProcessPool:
                pool.shutdown(wait=True, cancel_futures=True)
                yield from _one_by_one(function, tasks, ahead)
                pool = _pool(workers)
                continue
            ahead.popleft()
            yield result
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _one_by_one(
    function: Callable[[Any], Any], tasks: Sequence[Any], ahead: _Ahead
) -> Generator[Any, None, None]:
    """Run again what was under way when a process died, each with nothing beside it."""
    pool = _pool(1)
    try:
        _submit(pool, int).result()
    except BrokenProcessPool as error:
        raise InputError(
            "workers: no process can be started; use workers=1, or put the call of a script "
            "under: if __name__ == '__main__'"
        ) from error
    try:
        while ahead:
            index, future = ahead.popleft()
            if future.done() and not future.cancelled() and future.exception() is None:
                yield future.result()
                continue
            try:
                result = _submit(pool, _guarded, function, tasks[index]).result()
            except BrokenProcessPool:
                pool.shutdown(wait=True, cancel_futures=True)
                pool = _pool(1)
                result = Failure("ProcessDied", "its process died: a crash or no memory left")
            yield result
    finally:
        pool.shutdown(wait=True, cancel_futures=True)


def _submit(pool: ProcessPoolExecutor, *call: Any) -> Future[Any]:
    """Submit a call; a worker that is started for it never sees Ctrl-C, not even while it loads.

    A blocked signal stays blocked in a new process; in this one it is delivered afterwards.
    """
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        return pool.submit(*call)
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        return pool.submit(*call)
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _pool(workers: int) -> ProcessPoolExecutor:
    return ProcessPoolExecutor(
        max_workers=workers,
        mp_context=multiprocessing.get_context("spawn"),
        initializer=_leave_interrupts,
    )


def _leave_interrupts() -> None:
    """Ctrl-C reaches every process of the terminal; only the first is to act on it."""
    with contextlib.suppress(ValueError):
        signal.signal(signal.SIGINT, signal.SIG_IGN)
