"""Calls done in processes of this machine, each of which may crash or hang without harm."""

import concurrent.futures
import contextlib
import ctypes
import logging
import multiprocessing
import os
import pickle
import signal
import sys
import threading
from collections.abc import Callable
from multiprocessing.context import SpawnContext, SpawnProcess
from typing import Any

from qs3.errors import TOLD, InputError, say_once
from qs3.processors import script_hidden
from qs3.store.executors.executor import Failure, guarded

_LIBRARIES = ("OMP", "OPENBLAS", "MKL", "VECLIB_MAXIMUM")
ONE_THREAD = {f"{name}_NUM_THREADS": "1" for name in _LIBRARIES} | {"OPENCV_FOR_THREADS_NUM": "1"}
"""Environment in which the libraries use one thread: workers share the cores."""
_BROKEN = "the worker processes died; if memory is short, use fewer workers; run the same again"


class _Process(SpawnProcess):
    @staticmethod
    def _Popen(process_obj: Any) -> Any:  # noqa: N802
        with script_hidden():
            return SpawnProcess._Popen(process_obj)  # type: ignore[attr-defined]


class LocalExecutor:
    """A pool of processes started afresh (spawn).

    A call whose process dies, or that takes longer than ``timeout`` seconds, has failed; the
    process is replaced. Workers end by themselves when this process is killed.
    """

    def __init__(self, workers: int = 1, timeout: float | None = None) -> None:
        """Check the settings; no process starts yet."""
        if workers < 1:
            raise InputError(f"workers must be at least 1, not {workers}")
        if timeout is not None and not timeout > 0:
            raise InputError(f"timeout must be above 0 seconds, not {timeout}")
        self.ahead = 2 * workers
        self._workers, self._timeout = workers, timeout
        self._keys: dict[Any, Any] = {}

    def submit(self, key: Any, function: Callable[..., Any], *arguments: Any) -> None:
        """Submit a call."""
        packed = pickle.dumps((function, *arguments))
        if b"__main__" in packed:  # parts of the caller's script, which the workers then load
            self._kind = SpawnProcess
        try:
            self._keys[self._pool.schedule(_call, args=(packed,), timeout=self._timeout)] = key
        except RuntimeError as error:
            raise InputError(_BROKEN) from error

    def next(self) -> tuple[Any, Any]:
        """Wait for any call."""
        from concurrent.futures.process import BrokenProcessPool

        from pebble import ProcessExpired

        done, _ = concurrent.futures.wait(self._keys, return_when="FIRST_COMPLETED")
        future = next(iter(done))
        key = self._keys.pop(future)
        try:
            outcome, warned = future.result()
            for kind, text in warned.items():
                say_once(text, kind)
            return key, outcome
        except concurrent.futures.TimeoutError:
            return key, Failure("Timeout", f"took over {self._timeout:g} s and was stopped")
        except ProcessExpired as error:
            return key, Failure("ProcessDied", f"its process died ({_cause(error.exitcode)})")
        except BrokenProcessPool as error:
            raise InputError(_BROKEN) from error

    def __enter__(self) -> "LocalExecutor":
        """Start; processes come with the first call."""
        from pebble import ProcessPool

        # A process loads its libraries before any code of ours can limit their threads.
        self._environment = {name: os.environ.get(name) for name in ONE_THREAD}
        os.environ.update(ONE_THREAD)
        self._context: Any = SpawnContext()
        self._context.Process = self._process
        self._kind: type[SpawnProcess] = _Process
        self._started: list[SpawnProcess] = []
        self._pool = ProcessPool(self._workers, initializer=_prepare_worker, context=self._context)
        return self

    def _process(self, *values: Any, **named: Any) -> SpawnProcess:
        """Return a new process, and remember those that live."""
        process = self._kind(*values, **named)
        self._started = [*filter(SpawnProcess.is_alive, self._started), process]
        return process

    def __exit__(self, *exception: object) -> None:
        """Stop the processes."""
        self._pool.stop()  # none is replaced from here on
        # pebble takes their locks away first, and one that is starting prints a traceback then.
        for process in self._started:
            if process.is_alive():
                process.terminate()
        self._pool.join()
        self._keys.clear()
        for name, value in self._environment.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


def _cause(code: int) -> str:
    with contextlib.suppress(ValueError):
        return f"signal {signal.Signals(-code).name}"
    return f"exit code {code}"


def _call(packed: bytes) -> Any:
    """Do a call; pebble would unpack it, and import, under the lock that all workers share."""
    return guarded(_unpack_and_call, packed), TOLD


def _unpack_and_call(packed: bytes) -> Any:
    function, *arguments = pickle.loads(packed)  # noqa: S301
    return function(*arguments)


def _prepare_worker() -> None:
    """Leave Ctrl-C and warnings to the first process, and end when it is gone."""
    from tqdm import tqdm

    # A semaphore between processes, as tqdm makes one, would outlive a worker that is stopped.
    tqdm.set_lock(threading.RLock())
    logging.getLogger(say_once.__module__).disabled = True
    with contextlib.suppress(ValueError):
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        # pebble's own handler runs Python wherever the signal comes, in the middle of a compilation
        # too, whose traceback it then prints. There is nothing to clean up.
        signal.signal(signal.SIGTERM, signal.SIG_DFL)
    if sys.platform == "linux":  # also if a mesh hangs in C and no Python runs any more
        set_death_signal = 1
        ctypes.CDLL(None).prctl(set_death_signal, signal.SIGKILL)
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    multiprocessing.parent_process().join()  # type: ignore[union-attr]
    os._exit(1)
