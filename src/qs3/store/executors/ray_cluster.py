"""Calls done on a Ray cluster; needs the extra ``ray``."""

import contextlib
import os
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from qs3.errors import InputError, MissingExtraError
from qs3.store.executors.executor import Failure, guarded
from qs3.store.executors.local import ONE_THREAD

_LOOK_EVERY = 1.0  # seconds between two looks at what has run too long


class RayExecutor:
    """Each call is a task of one core, made again where its machine or process is lost.

    What a call reads and writes must be reached from every machine under the same name. A call
    that takes longer than ``timeout`` is stopped and has failed.
    """

    def __init__(
        self,
        address: str = "auto",
        timeout: float | None = None,
        gpus: float = 0.0,
        retries: int = 3,
    ) -> None:
        """Prepare; nothing is connected to yet.

        Args:
            address: Of the cluster's head, ``auto`` for the one that this machine belongs to, or
                ``local`` to start one here.
            timeout: Seconds that one call may take once it runs; None waits for ever.
            gpus: Share of a GPU that one call takes.
            retries: Times that a call is made again after its machine or process died.

        Raises:
            InputError: where a number is out of range.
            MissingExtraError: where Ray is not installed.
        """
        if timeout is not None and not timeout > 0:
            raise InputError(f"timeout must be above 0 seconds, not {timeout}")
        if not 0 <= gpus < float("inf"):
            raise InputError(f"gpus-per-scan must not be negative, but is {gpus}")
        if retries < 0:
            raise InputError(f"retries must not be negative, but is {retries}")
        try:
            import ray
        except ImportError as error:
            raise MissingExtraError("ray", "ray") from error
        self._ray: Any = ray
        self._address, self._timeout, self._gpus, self._retries = address, timeout, gpus, retries
        self._calls: dict[Any, tuple[Any, int]] = {}
        self._stopped: set[int] = set()
        self._count = 0
        self._looked = 0.0
        self._connected_here = False

    @property
    def ahead(self) -> int:
        """Twice the cores that the cluster has at this moment."""
        if not self._ray.is_initialized():
            return 2
        return max(2 * int(self._ray.cluster_resources().get("CPU", 1)), 2)

    def submit(self, key: Any, function: Callable[..., Any], *arguments: Any) -> None:
        """Hand over a call."""
        self._count += 1
        reference = self._task.remote(
            self._clock, self._count, str(Path.cwd()), function, arguments
        )
        self._calls[reference] = (key, self._count)

    def next(self) -> tuple[Any, Any]:
        """Wait for any call."""
        while True:
            self._stop_what_hangs()
            done, _ = self._ray.wait(list(self._calls), num_returns=1, timeout=_LOOK_EVERY)
            if done:
                key, number = self._calls.pop(done[0])
                return key, self._outcome(done[0], number)

    def _outcome(self, reference: Any, number: int) -> Any:
        try:
            return self._ray.get(reference)
        except self._ray.exceptions.RayTaskError as error:
            # It failed before any code of ours ran: qs3 or a module of it is missing there.
            cause = error.cause or error
            lines = str(cause).strip().splitlines() or [""]
            return Failure(type(cause).__name__, f"on the cluster: {lines[0]}", fatal=True)
        except self._ray.exceptions.RayError as error:
            if number in self._stopped:
                return Failure("Timeout", f"took over {self._timeout:g} s and was stopped")
            what = str(error).strip().splitlines()
            return Failure("ProcessDied", f"lost {self._retries + 1} times ({what[0]})")

    def _stop_what_hangs(self) -> None:
        if self._timeout is None or time.monotonic() - self._looked < _LOOK_EVERY:
            return
        self._looked = time.monotonic()
        try:
            running = self._ray.get(self._clock.running.remote(), timeout=10 * _LOOK_EVERY)
        except self._ray.exceptions.RayError:  # the clock is being started again
            return
        for reference, (_, number) in self._calls.items():
            if running.get(number, 0.0) > self._timeout and number not in self._stopped:
                self._stopped.add(number)
                self._ray.cancel(reference, force=True)

    def drain(self) -> list[tuple[Any, Any]]:
        """Let the calls under way end, and drop the others; what ended."""
        running: dict[int, float] = {}
        with contextlib.suppress(self._ray.exceptions.RayError):
            running = self._ray.get(self._clock.running.remote(), timeout=10 * _LOOK_EVERY)
        wait = []
        for reference, (_, number) in self._calls.items():
            if number in running:
                wait.append(reference)
            else:
                self._ray.cancel(reference)
        done = []
        if wait:
            done, _ = self._ray.wait(wait, num_returns=len(wait), timeout=self._timeout)
        ended = [(self._calls[r][0], self._outcome(r, self._calls[r][1])) for r in done]
        self._calls.clear()
        return ended

    def __enter__(self) -> "RayExecutor":
        """Connect.

        Raises:
            InputError: where there is no cluster at the address.
        """
        ray = self._ray
        if not ray.is_initialized():
            try:
                ray.init(
                    address=None if self._address == "local" else self._address,
                    include_dashboard=False if self._address == "local" else None,
                    log_to_driver=False,
                    logging_level="warning",
                )
            except (ConnectionError, ValueError, RuntimeError) as error:
                raise InputError(
                    f"--address {self._address}: no Ray cluster answers there; start one with "
                    "'ray start --head', or use --address local"
                ) from error
            self._connected_here = True
        if self._gpus and not ray.cluster_resources().get("GPU"):
            raise InputError(
                f"--gpus-per-scan {self._gpus:g}: the cluster has no GPU at this moment; add a "
                "machine with one, or leave the flag out"
            )
        here = ray.util.scheduling_strategies.NodeAffinitySchedulingStrategy(
            ray.get_runtime_context().get_node_id(), soft=True
        )
        clock = ray.remote(num_cpus=0, max_restarts=-1, scheduling_strategy=here)(_Clock)
        self._clock = clock.remote()
        self._task = ray.remote(
            num_cpus=1,
            num_gpus=self._gpus,
            max_retries=self._retries,
            retry_exceptions=False,
            runtime_env={"env_vars": ONE_THREAD},
        )(_timed)
        return self

    def __exit__(self, *exception: object) -> None:
        """Stop what is left, and disconnect."""
        for reference in self._calls:
            self._ray.cancel(reference, force=True)
        self._calls.clear()
        self._ray.kill(self._clock)
        if self._connected_here:
            self._ray.shutdown()


class _Clock:
    """Knows which calls run, and for how long."""

    def __init__(self) -> None:
        self._begun: dict[int, float] = {}

    def begin(self, number: int) -> None:
        self._begun[number] = time.monotonic()

    def end(self, number: int) -> None:
        self._begun.pop(number, None)

    def running(self) -> dict[int, float]:
        now = time.monotonic()
        return {number: now - begun for number, begun in self._begun.items()}


def _timed(
    clock: Any, number: int, folder: str, function: Callable[..., Any], arguments: tuple[Any, ...]
) -> Any:
    """Make a call on a machine of the cluster."""
    try:
        os.chdir(folder)  # names are relative to where the command was typed
    except OSError as error:
        reason = f"{folder}: not there on a machine of the cluster ({error.strerror})"
        return Failure("OSError", reason, fatal=True)
    clock.begin.remote(number)
    try:
        return guarded(function, *arguments)
    finally:
        clock.end.remote(number)
