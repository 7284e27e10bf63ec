"""Work that is done anew whenever its settings change: in one thread, the last change wins."""

import logging
import threading
import time
from collections.abc import Callable
from typing import Generic, Literal, TypeVar

Settings = TypeVar("Settings")
Result = TypeVar("Result")

_LOG = logging.getLogger(__name__)


class Rescanner(Generic[Settings, Result]):
    """Runs ``work`` on the settings asked for last, in a thread of its own.

    A change waits until none has come for ``delay`` seconds. What a change overtakes while it is
    under way is finished, as a renderer cannot be stopped, but never shown.

    Example:
        >>> results, done = [], threading.Event()
        >>> show = lambda result: (results.append(result), done.set())
        >>> worker = Rescanner(lambda x: 2 * x, show, delay=0.0)
        >>> worker.ask(21)
        >>> done.wait(10), results
        (True, [42])
        >>> worker.close()
        True
    """

    def __init__(
        self,
        work: Callable[[Settings], Result],
        show: Callable[[Result], object],
        fail: Callable[[Exception], object] = lambda error: None,
        delay: float = 0.3,
        tell: Callable[[Literal["waiting", "working"]], object] = lambda state: None,
    ) -> None:
        """Start the thread.

        Args:
            work: Turns settings into a result; may raise anything.
            show: Takes the result of the last settings; called in the thread.
            fail: Takes the fault of the last settings; called in the thread.
            delay: Seconds without a change before the work begins.
            tell: Takes the state when it changes; called in the thread, or in that of `ask`.
        """
        self._work, self._show, self._fail = work, show, fail
        self._tell, self._delay = tell, delay
        self._news = threading.Condition()
        self._asked: tuple[int, Settings, float] | None = None
        self._number = 0
        self._closed = False
        # A daemon: a scan that hangs must not keep the program from ending.
        self._thread = threading.Thread(target=self._run, name="rescan", daemon=True)
        self._thread.start()

    def ask(self, settings: Settings) -> None:
        """Ask for a result; what was asked for before and is not yet shown never will be."""
        with self._news:
            self._number += 1
            self._asked = (self._number, settings, time.monotonic() + self._delay)
            self._news.notify_all()
        self._guard(self._tell, "waiting")

    def close(self, timeout: float = 30.0) -> bool:
        """Stop after the work under way; False where that took more than ``timeout`` seconds."""
        with self._news:
            self._closed, self._asked = True, None
            self._news.notify_all()
        self._thread.join(timeout)
        return not self._thread.is_alive()

    def _run(self) -> None:
        while (asked := self._next()) is not None:
            number, settings = asked
            self._guard(self._tell, "working")
            try:
                show, outcome = self._show, self._work(settings)
            except Exception as error:
                show, outcome = self._fail, error
            with self._news:
                overtaken = self._closed or number != self._number
            if not overtaken:
                self._guard(show, outcome)

    def _next(self) -> tuple[int, Settings] | None:
        """Wait for settings that nothing has changed for a while; None when closed."""
        with self._news:
            while not self._closed:
                if self._asked is None:
                    self._news.wait()
                    continue
                number, settings, due = self._asked
                if (left := due - time.monotonic()) > 0:
                    self._news.wait(left)
                    continue
                self._asked = None
                return number, settings
        return None

    @staticmethod
    def _guard(call: Callable[..., object], *arguments: object) -> None:
        """A page that cannot be drawn must not end the worker."""
        try:
            call(*arguments)
        except Exception:
            _LOG.exception("the viewer's page could not be brought up to date")
