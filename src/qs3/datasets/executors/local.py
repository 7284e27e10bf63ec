"""Calls done in processes of this machine, each of which may crash or hang without harm."""

import concurrent.futures
import contextlib
import multiprocessing
import os
import signal
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

from qs3.datasets.executors.executor import Failure, guarded
from qs3.errors import InputError

_BROKEN_IN_A_ROW = 3


@dataclass(frozen=True)
class _Call:
    key: Any
    function: Callable[..., Any]
    arguments: tuple[Any, ...]
    retried: bool = False


class LocalExecutor:
    """A pool of processes started afresh (spawn).

    A worker that dies is replaced and its call is made once more; one that takes longer than
    ``timeout`` is killed and replaced, and its call has failed. Workers end by themselves when
    this process is killed.
    """

    def __init__(self, workers: int = 1, timeout: float | None = None) -> None:
        """Prepare.

        Args:
            workers: Processes.
            timeout: Seconds that one call may take; None waits for ever.

        Raises:
            InputError: where a number is out of range.
        """
        if workers < 1:
            raise InputError(f"workers must be at least 1, not {workers}")
        if timeout is not None and not timeout > 0:
            raise InputError(f"timeout must be above 0 seconds, not {timeout}")
        self.ahead = 2 * workers
        self._workers = workers
        self._timeout = timeout
        self._calls: dict[Any, _Call] = {}
        self._broken = 0

    def submit(self, key: Any, function: Callable[..., Any], *arguments: Any) -> None:
        """Hand over a call."""
        self._schedule(_Call(key, function, arguments))

    def _schedule(self, call: _Call) -> None:
        # The first call starts the processes, from threads that inherit what is blocked here:
        # Ctrl-C reaches every process of the terminal, and only the first is to act on it.
        with _interrupt_blocked():
            future = self._pool.schedule(
                guarded, args=(call.function, *call.arguments), timeout=self._timeout
            )
        self._calls[future] = call

    def next(self) -> tuple[Any, Any]:
        """Wait for any call.

        Raises:
            InputError: where no worker process can start.
        """
        while True:
            done, _ = concurrent.futures.wait(self._calls, return_when="FIRST_COMPLETED")
            future = next(iter(done))
            call = self._calls.pop(future)
            outcome = self._outcome(future, call)
            if not isinstance(outcome, _Again):
                return call.key, outcome

    def _outcome(self, future: Any, call: _Call) -> Any:
        from concurrent.futures.process import BrokenProcessPool

        from pebble import ProcessExpired

        try:
            value = future.result()
        except concurrent.futures.TimeoutError:
            return Failure("Timeout", f"took over {self._timeout:g} s and was stopped")
        except ProcessExpired as error:
            if call.retried:
                return Failure("ProcessDied", f"its process died twice ({_how(error.exitcode)})")
            self._schedule(_Call(call.key, call.function, call.arguments, retried=True))
            return _Again()
        except BrokenProcessPool as error:
            self._restart(call, error)
            return _Again()
        except Exception as error:  # it could not be sent, or its value could not come back
            return Failure(type(error).__name__, str(error))
        self._broken = 0
        return value

    def _restart(self, call: _Call, error: Exception) -> None:
        """Start a new pool where one broke as a whole: a worker died before its first call."""
        self._broken += 1
        if self._broken > _BROKEN_IN_A_ROW:
            raise InputError(
                "workers: no process can be started; use workers=0, or put the call of a script "
                "under: if __name__ == '__main__'"
            ) from error
        calls = [call, *self._calls.values()]
        self._calls.clear()
        self._close(at_once=True)
        self._open()
        for waiting in calls:
            self._schedule(waiting)

    def drain(self) -> None:
        """Let the calls under way end, and drop the others."""
        for future in [future for future in self._calls if not future.running()]:
            future.cancel()
        running = [future for future in self._calls if not future.cancelled()]
        concurrent.futures.wait(running)
        self._calls.clear()

    def _open(self) -> None:
        from pebble import ProcessPool

        context: Any = multiprocessing.get_context("spawn")
        self._pool = ProcessPool(self._workers, initializer=_prepare_worker, context=context)

    def _close(self, at_once: bool) -> None:
        if at_once:
            self._pool.stop()
        else:
            self._pool.close()
        self._pool.join()

    def __enter__(self) -> "LocalExecutor":
        """Start; processes come with the first call."""
        self._open()
        return self

    def __exit__(self, *exception: object) -> None:
        """Stop the processes, at once where calls are left."""
        self._close(at_once=bool(self._calls))


class _Again:
    """The call was handed over once more."""


def _how(code: int) -> str:
    if code < 0:
        with contextlib.suppress(ValueError):
            return f"signal {signal.Signals(-code).name}: a crash, or no memory left"
    return f"exit code {code}"


@contextlib.contextmanager
def _interrupt_blocked() -> Iterator[None]:
    """A blocked signal stays blocked in new threads and processes; here it comes afterwards."""
    if not hasattr(signal, "pthread_sigmask"):  # Windows
        yield
        return
    before = signal.pthread_sigmask(signal.SIG_BLOCK, {signal.SIGINT})
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def one_thread() -> None:
    """Let the libraries of this process, none loaded yet, use one thread: workers share cores."""
    for name in ("OMP", "OPENBLAS", "MKL", "VECLIB_MAXIMUM"):
        os.environ[f"{name}_NUM_THREADS"] = "1"
    os.environ["OPENCV_FOR_THREADS_NUM"] = "1"


def _prepare_worker() -> None:
    """Use one thread, leave Ctrl-C to the first process, and end when it is gone."""
    one_thread()
    with contextlib.suppress(ValueError):
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_end_with, args=(parent,), daemon=True).start()


def _end_with(parent: Any) -> None:
    parent.join()
    os._exit(1)
