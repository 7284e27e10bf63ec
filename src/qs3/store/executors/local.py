"""Calls done in processes of this machine, each of which may crash or hang without harm."""

import collections
import concurrent.futures
import contextlib
import ctypes
import dataclasses
import multiprocessing
import os
import pickle
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from multiprocessing.context import SpawnContext, SpawnProcess
from multiprocessing.reduction import ForkingPickler
from typing import Any

from qs3.errors import InputError
from qs3.processors import script_hidden
from qs3.store.executors.executor import Failure, guarded

_BROKEN_IN_A_ROW = 3
_DEATHS = 3
_KILLED_FROM_OUTSIDE = (-9, -15)
_LOCK_SECONDS = 5.0
"""A worker waits so long for the lock that all share, held for milliseconds at a time. One that was
killed with it never gives it back: those that wait then end, and the pool is opened anew."""
_NO_PROCESS = "workers: no process can be started; use workers=0"
_LIBRARIES = ("OMP", "OPENBLAS", "MKL", "VECLIB_MAXIMUM")
ONE_THREAD = {f"{name}_NUM_THREADS": "1" for name in _LIBRARIES} | {"OPENCV_FOR_THREADS_NUM": "1"}
"""Environment in which the libraries use one thread: workers share the cores."""


@dataclass(frozen=True)
class _Call:
    key: Any
    function: Callable[..., Any]
    arguments: tuple[Any, ...]
    deaths: int = 0


class _Process(SpawnProcess):
    @staticmethod
    def _Popen(process_obj: Any) -> Any:  # noqa: N802
        with script_hidden():
            return SpawnProcess._Popen(process_obj)  # type: ignore[attr-defined]


class LocalExecutor:
    """A pool of processes started afresh (spawn).

    A worker that dies is replaced, and its call is made again, twice, while no other is under
    way, so that no want of memory for several at once is taken for its fault. Then the call has
    failed where the last of them crashed (``ProcessDied``); where it was killed from outside, as
    by a system short of memory, it is no fault of the call (``Killed``). One that takes longer
    than ``timeout`` is killed and replaced, and its call has failed. Workers end by themselves
    when this process is killed.
    """

    def __init__(
        self, workers: int = 1, timeout: float | None = None, calls_per_process: int = 0
    ) -> None:
        """Prepare.

        Args:
            workers: Processes.
            timeout: Seconds that one call may take; None waits for ever.
            calls_per_process: Calls after which a process is replaced; 0 keeps it.

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
        self._calls_per_process = calls_per_process
        self._calls: dict[Any, _Call] = {}
        self._alone: collections.deque[_Call] = collections.deque()
        self._broken = 0

    def submit(self, key: Any, function: Callable[..., Any], *arguments: Any) -> None:
        """Hand over a call."""
        self._schedule(_Call(key, function, arguments))

    def _schedule(self, call: _Call) -> None:
        # The first call starts the processes, from threads that inherit what is blocked here:
        # Ctrl-C reaches every process of the terminal, and only the first is to act on it.
        try:  # in pebble's own thread a fault would go unseen
            packed = bytes(ForkingPickler.dumps((call.function, *call.arguments)))
        except Exception as error:
            raise InputError(f"a call cannot be sent to another process ({error})") from error
        if b"__main__" in packed:  # it is made of parts of the caller's script
            self._context.Process = SpawnProcess
        for _ in range(_BROKEN_IN_A_ROW):
            try:
                with _interrupt_blocked():
                    future = self._pool.schedule(_call, args=(packed,), timeout=self._timeout)
            except RuntimeError:  # the pool broke while nobody looked: an idle process died
                self._reopen()
                continue
            self._calls[future] = call
            return
        raise InputError(_NO_PROCESS)

    def next(self) -> tuple[Any, Any]:
        """Wait for any call.

        Raises:
            InputError: where no worker process can start.
        """
        from concurrent.futures.process import BrokenProcessPool

        from pebble import ProcessExpired

        while True:
            if not self._calls:
                self._schedule(self._alone.popleft())
            done, _ = concurrent.futures.wait(self._calls, return_when="FIRST_COMPLETED")
            future = next(iter(done))
            call = self._calls.pop(future)
            try:
                value = future.result()
            except concurrent.futures.TimeoutError:
                value = Failure("Timeout", f"took over {self._timeout:g} s and was stopped")
            except ProcessExpired as error:
                call = dataclasses.replace(call, deaths=call.deaths + 1)
                if call.deaths < _DEATHS:
                    self._alone.append(call)
                    continue
                how = f"its process died {call.deaths} times, twice with no other beside it"
                kind = "Killed" if error.exitcode in _KILLED_FROM_OUTSIDE else "ProcessDied"
                value = Failure(kind, f"{how} ({_how(error.exitcode)})")
            except BrokenProcessPool as error:  # a worker died before its first call
                self._broken += 1
                if self._broken > _BROKEN_IN_A_ROW:
                    raise InputError(_NO_PROCESS) from error
                self._calls[future] = call
                self._reopen()
                continue
            except Exception as error:  # its value could not come back; no other's will
                value = Failure(type(error).__name__, str(error), fatal=True)
            else:
                self._broken = 0
            return call.key, value

    def _reopen(self) -> None:
        """Replace the pool, and hand over anew what it had."""
        calls = list(self._calls.values())
        self._calls.clear()
        self._close(at_once=True)
        self._open()
        for waiting in calls:
            self._schedule(waiting)

    def drain(self) -> list[tuple[Any, Any]]:
        """Let the calls under way end, and drop the others; what ended."""
        for future in [future for future in self._calls if not future.running()]:
            future.cancel()
        running = {f: call for f, call in self._calls.items() if not f.cancelled()}
        concurrent.futures.wait(running)
        self._calls.clear()
        self._alone.clear()
        ended = [(call.key, f) for f, call in running.items() if f.exception() is None]
        return [(key, future.result()) for key, future in ended]

    def _open(self) -> None:
        from pebble import ProcessPool

        # Here, since a process loads its libraries before any code of ours can tell it.
        self._environment = {name: os.environ.get(name) for name in ONE_THREAD}
        os.environ.update(ONE_THREAD)
        self._context: Any = SpawnContext()
        self._context.Process = _Process
        self._pool = ProcessPool(
            self._workers,
            max_tasks=self._calls_per_process,
            initializer=_prepare_worker,
            context=self._context,
        )

    def _close(self, at_once: bool) -> None:
        if at_once:
            self._pool.stop()
        else:
            self._pool.close()
        self._pool.join()
        for name, value in self._environment.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value

    def __enter__(self) -> "LocalExecutor":
        """Start; processes come with the first call."""
        self._open()
        return self

    def __exit__(self, *exception: object) -> None:
        """Stop the processes, at once where an exception ends the block: some may not be up yet."""
        self._alone.clear()
        self._close(at_once=bool(self._calls) or any(exception))


def _how(code: int) -> str:
    if code < 0:
        with contextlib.suppress(ValueError):
            what = "no memory left, or a kill" if code in _KILLED_FROM_OUTSIDE else "a crash"
            return f"signal {signal.Signals(-code).name}: {what}"
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


def _call(packed: bytes) -> Any:
    """Call what was sent. It is unpacked here, since pebble unpacks under the lock that all share.

    The first call imports the modules of what it is made of, for seconds on a busy machine.
    """
    return guarded(*pickle.loads(packed))  # noqa: S301


def _prepare_worker() -> None:
    """Leave Ctrl-C to the first process, and end when it is gone or died with the lock."""
    import pebble

    pebble.CONSTS.channel_lock_timeout = _LOCK_SECONDS
    with contextlib.suppress(ValueError):
        signal.signal(signal.SIGINT, signal.SIG_IGN)
    if sys.platform == "linux":
        # Also where a mesh hangs in C and no Python runs any more.
        set_death_signal = 1
        ctypes.CDLL(None).prctl(set_death_signal, signal.SIGKILL)
    end_with_parent()


def end_with_parent() -> None:
    """Let this process end when the one that started it is gone."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        threading.Thread(target=_end_with, args=(parent,), daemon=True).start()


def _end_with(parent: Any) -> None:
    parent.join()
    os._exit(1)
