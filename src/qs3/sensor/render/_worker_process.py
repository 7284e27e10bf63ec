"""A child process that renders: started when needed, replaced when it fails, never left behind.

The child keeps to a small protocol: lines of JSON in, lines of JSON behind a mark out, everything
else it prints is talk. See ``_cycles_worker.py``, the child itself.
"""

import atexit
import contextlib
import json
import os
import queue
import shutil
import signal
import subprocess
import tempfile
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import IO, Any

from qs3.errors import QS3Error

_MARK = "@qs3 "
_START_SECONDS = 300.0


class RenderError(QS3Error, RuntimeError):
    """A renderer's own process failed; the object it was given fails, the next one does not."""


class Worker:
    """One child process and its private folder."""

    def __init__(self, command: tuple[str, ...]) -> None:
        """Start the child and wait until it is ready.

        Raises:
            RenderError: if it does not start.
        """
        self.folder = Path(tempfile.mkdtemp(prefix="qs3-cycles-"))
        self.objects = 0
        self._lines: queue.SimpleQueue[str | None] = queue.SimpleQueue()
        try:
            with (self.folder / "worker.log").open("wb") as log:
                # Its own session: Ctrl-C in the terminal is the parent's to act on.
                self._process = subprocess.Popen(
                    [*command, str(self.folder)],
                    stdin=subprocess.PIPE,
                    stdout=subprocess.PIPE,
                    stderr=log,
                    start_new_session=True,
                )
        except OSError as error:
            shutil.rmtree(self.folder, ignore_errors=True)
            raise RenderError(f"{command[0]} does not start: {error.strerror}") from error
        stdout = self._process.stdout
        assert stdout is not None  # noqa: S101  (asked for above)
        threading.Thread(target=_listen, args=(stdout, self._lines), daemon=True).start()
        try:
            self.greeting = self.receive("ready", _START_SECONDS)
        except BaseException:
            self.close()
            raise

    @property
    def pid(self) -> int:
        """Process id of the child."""
        return self._process.pid

    @property
    def ended(self) -> bool:
        """Return whether the child runs no more."""
        return self._process.poll() is not None

    def send(self, request: dict[str, Any]) -> None:
        """Hand the child one request; a child that is gone is noticed by `receive`."""
        stdin = self._process.stdin
        assert stdin is not None  # noqa: S101
        with contextlib.suppress(BrokenPipeError):
            stdin.write(json.dumps(request).encode() + b"\n")
            stdin.flush()

    def receive(self, event: str, timeout: float) -> dict[str, Any]:
        """Wait for one answer of the child; other output is skipped.

        Raises:
            RenderError: if it died, kept silent for ``timeout`` seconds or reports a fault.
        """
        deadline = time.monotonic() + timeout
        while True:
            try:
                line = self._lines.get(timeout=max(0.0, deadline - time.monotonic()))
            except queue.Empty:
                raise self._fault(f"kept silent for {timeout:g} s") from None
            if line is None:
                raise self._fault(self._end())
            answer = _parse(line)
            if answer is None:
                continue
            if answer.get("event") == event:
                return answer
            reason = answer.get("reason", f"answered {answer.get('event')!r}, not {event!r}")
            raise self._fault(f"failed: {reason}")

    def _fault(self, what: str) -> RenderError:
        """One line: what happened and the last that the child printed."""
        text = ""
        with contextlib.suppress(OSError):
            text = (self.folder / "worker.log").read_text(errors="replace")
        lines = [line.strip() for line in text.splitlines() if line.strip()]
        end = f"; its log ends: {' | '.join(lines[-4:])}" if lines else ""
        return RenderError(f"the renderer's process {what}{end}")

    def close(self) -> None:
        """End the child and all of its children now, and remove the folder."""
        self.release()
        if os.name == "posix":
            with contextlib.suppress(ProcessLookupError, PermissionError):
                os.killpg(self._process.pid, signal.SIGKILL)
        else:
            self._process.kill()
        self._process.wait()
        shutil.rmtree(self.folder, ignore_errors=True)

    def release(self) -> None:
        """Close this process's end of the pipe; the child ends with the last one."""
        if self._process.stdin is not None:
            with contextlib.suppress(OSError):
                self._process.stdin.close()

    def _end(self) -> str:
        try:
            code = self._process.wait(1)
        except subprocess.TimeoutExpired:
            return "closed its output"
        if code >= 0:
            return f"ended with exit code {code}"
        return f"was killed by signal {signal.Signals(-code).name}"


_idle: dict[tuple[str, ...], Worker] = {}
_busy: set[Worker] = set()
_lock = threading.RLock()


@contextlib.contextmanager
def borrow(command: tuple[str, ...], objects: int) -> Iterator[Worker]:
    """Lend this process's worker for one object, and start one if there is none.

    Args:
        command: Program and arguments; each command has its own worker.
        objects: Objects after which a worker is replaced; 0 is never.

    Raises:
        RenderError: if it does not start. Any exception of the body ends the worker.
    """
    with _lock:
        worker = _idle.pop(command, None)
    if worker is not None and (worker.ended or 0 < objects <= worker.objects):
        worker.close()
        worker = None
    worker = worker or Worker(command)
    _busy.add(worker)
    try:
        yield worker
    except BaseException:
        worker.close()
        raise
    finally:
        _busy.discard(worker)
    worker.objects += 1
    with _lock:
        spare, _idle[command] = _idle.get(command), worker
    if spare is not None:  # another thread's
        spare.close()


def close_workers() -> None:
    """End every child of this process that renders nothing at the moment."""
    with _lock:
        while _idle:
            _idle.popitem()[1].close()


def _forget() -> None:
    """In a forked child: the parent's workers are not ours; let go of their pipes only."""
    global _lock
    _lock = threading.RLock()
    for worker in [*_idle.values(), *_busy]:
        worker.release()
    _idle.clear()
    _busy.clear()


def _listen(stream: IO[bytes], lines: "queue.SimpleQueue[str | None]") -> None:
    with stream:
        for line in stream:
            lines.put(line.decode("utf-8", errors="replace"))
    lines.put(None)


def _parse(line: str) -> dict[str, Any] | None:
    """The answer in a line, or None if it is talk."""
    if not line.startswith(_MARK):
        return None
    try:
        answer = json.loads(line[len(_MARK) :])
    except ValueError:
        return None
    return answer if isinstance(answer, dict) else None


atexit.register(close_workers)
if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_forget)
