"""Calls done on a Ray cluster; needs the extra ``ray``."""

import contextlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from qs3.errors import InputError, MissingExtraError
from qs3.store.executors.executor import Failure
from qs3.store.executors.local import LocalExecutor

_own: LocalExecutor | None = None
"""The process beside a worker of the cluster in which its calls are done."""


class RayExecutor:
    """Each call is a task of one core, made again where its machine is lost.

    What a call reads and writes must be reached from every machine under the same name. On its
    machine a call is done in a process beside the cluster's own, see `LocalExecutor`: one that
    crashes it or takes longer than ``timeout`` has failed. So whatever the cluster itself tells of
    a task is a loss of the cluster's and never a call's fault.
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
            retries: Times that a call is made again after its machine was lost.

        Raises:
            InputError: where a number is out of range.
            MissingExtraError: where Ray is not installed.
        """
        LocalExecutor(1, timeout)  # refuses what is out of range
        if not 0 <= gpus < float("inf"):
            raise InputError(f"gpus-per-scan must not be negative, but is {gpus}")
        if retries < 0:
            raise InputError(f"retries must not be negative, but is {retries}")
        try:
            import ray
        except ImportError as error:
            raise MissingExtraError("ray", "ray", error) from error
        self._ray: Any = ray
        self._address, self._timeout, self._gpus, self._retries = address, timeout, gpus, retries
        self._keys: dict[Any, Any] = {}
        self._connected_here = False

    @property
    def ahead(self) -> int:
        """Twice the cores that the cluster has at this moment."""
        if not self._ray.is_initialized():
            return 2
        return max(2 * int(self._ray.cluster_resources().get("CPU", 1)), 2)

    def submit(self, key: Any, function: Callable[..., Any], *arguments: Any) -> None:
        """Hand over a call."""
        call = self._task.remote(self._timeout, str(Path.cwd()), function, arguments)
        self._keys[call] = key

    def next(self) -> tuple[Any, Any]:
        """Wait for any call.

        Raises:
            InputError: where the cluster lost it for good.
        """
        key: Any = None
        try:
            done, _ = self._ray.wait(list(self._keys), num_returns=1)
            key = self._keys.pop(done[0])
            return key, self._ray.get(done[0])
        except self._ray.exceptions.RayTaskError as error:
            # It failed before any code of ours ran: qs3 or a module of it is missing there.
            cause = error.cause or error
            lines = str(cause).strip().splitlines() or [""]
            return key, Failure(type(cause).__name__, f"on the cluster: {lines[0]}", fatal=True)
        except self._ray.exceptions.RayError as error:
            lines = str(error).strip().splitlines() or [""]
            raise InputError(
                f"--address {self._address}: the Ray cluster lost a call {self._retries + 1} times "
                f"or cannot be reached ({type(error).__name__}: {lines[0]}); once it works, run "
                "the same command again, nothing is lost"
            ) from error

    def drain(self) -> list[tuple[Any, Any]]:
        """Let the calls that were handed over end; what ended."""
        ended = []
        while self._keys:
            ended.append(self.next())
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
        self._task = ray.remote(
            num_cpus=1, num_gpus=self._gpus, max_retries=self._retries, retry_exceptions=False
        )(_call)
        return self

    def __exit__(self, *exception: object) -> None:
        """Stop what is left, and disconnect."""
        with contextlib.suppress(self._ray.exceptions.RayError):
            for reference in self._keys:
                self._ray.cancel(reference, force=True)
        self._keys.clear()
        if self._connected_here:
            self._ray.shutdown()


def _call(
    timeout: float | None, folder: str, function: Callable[..., Any], arguments: tuple[Any, ...]
) -> Any:
    """Make a call on a machine of the cluster, in a process that is kept for the next."""
    global _own
    if _own is None:
        _own = LocalExecutor(1, timeout).__enter__()
    _own.submit(None, _in_folder, folder, function, arguments)
    return _own.next()[1]


def _in_folder(folder: str, function: Callable[..., Any], arguments: tuple[Any, ...]) -> Any:
    try:
        os.chdir(folder)  # names are relative to where the command was typed
    except OSError as error:
        reason = f"{folder}: not there on a machine of the cluster ({error.strerror})"
        return Failure("OSError", reason, fatal=True)
    return function(*arguments)
