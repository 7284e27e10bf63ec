"""Calls done on a Ray cluster, whose values come back to this process; needs the extra ``ray``."""

import contextlib
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

from qs3.errors import InputError, MissingExtraError
from qs3.store.executors.executor import Failure
from qs3.store.executors.local import LocalExecutor

_beside: LocalExecutor | None = None
"""The process beside a worker of the cluster in which its calls are done."""


class RayExecutor:
    """Each call is a task of one core, made again if its machine is lost.

    The files that a call reads must have the same path on every machine. A call is done in a
    process of its own, see `LocalExecutor`: one that crashes or takes longer than ``timeout`` has
    failed, and any error of Ray is a loss of the cluster's.
    """

    def __init__(
        self, address: str = "auto", timeout: float | None = None, gpus: float = 0.0
    ) -> None:
        """Check the settings; nothing is connected yet.

        ``address`` is that of the cluster's head, ``auto`` for the cluster of this machine, or
        ``local`` to start one here; ``gpus`` is the share of a GPU that one call takes.
        """
        LocalExecutor(1, timeout)  # refuses what is out of range
        if not 0 <= gpus < float("inf"):
            raise InputError(f"gpus-per-scan must not be negative, but is {gpus}")
        try:
            import ray
        except ImportError as error:
            raise MissingExtraError("ray", "ray", error) from error
        self._ray: Any = ray
        self._address, self._timeout, self._gpus = address, timeout, gpus
        self._keys: dict[Any, Any] = {}

    @property
    def ahead(self) -> int:
        """Twice the cores that the cluster has at this moment; 2 before it is entered."""
        if not self._ray.is_initialized():
            return 2
        return max(2 * int(self._ray.cluster_resources().get("CPU", 1)), 2)

    def submit(self, key: Any, function: Callable[..., Any], *arguments: Any) -> None:
        """Submit a call."""
        call = self._task.remote(self._timeout, str(Path.cwd()), function, arguments)
        self._keys[call] = key

    def next(self) -> tuple[Any, Any]:
        """Wait for any call."""
        try:
            done, _ = self._ray.wait(list(self._keys), num_returns=1)
            return self._keys.pop(done[0]), self._ray.get(done[0])
        except self._ray.exceptions.RayError as error:
            reason = (str(error).strip().splitlines() or [""])[0]
            raise InputError(
                f"--address {self._address}: the Ray cluster lost a call or cannot be reached "
                f"({type(error).__name__}: {reason}); once it works, run the same command again"
            ) from error

    def __enter__(self) -> "RayExecutor":
        """Connect."""
        address = None if self._address == "local" else self._address
        self._connected_here = not self._ray.is_initialized()
        try:
            if self._connected_here:
                self._ray.init(address, log_to_driver=False, logging_level="warning")
        except (ConnectionError, ValueError, RuntimeError) as error:
            raise InputError(
                f"--address {self._address}: no Ray cluster answers there; start one with "
                "'ray start --head', or use --address local"
            ) from error
        if self._gpus and not self._ray.cluster_resources().get("GPU"):
            raise InputError(f"--gpus-per-scan {self._gpus:g}: the cluster has no GPU")
        self._task = self._ray.remote(num_cpus=1, num_gpus=self._gpus, max_retries=3)(_call)
        return self

    def __exit__(self, *exception: object) -> None:
        """Cancel what is left, and disconnect."""
        with contextlib.suppress(self._ray.exceptions.RayError):
            for reference in self._keys:
                self._ray.cancel(reference, force=True)
        self._keys.clear()
        if self._connected_here:
            self._ray.shutdown()


def _call(
    timeout: float | None, folder: str, function: Callable[..., Any], arguments: tuple[Any, ...]
) -> Any:
    """Do a call on a machine of the cluster, in a process that is kept for the next."""
    global _beside
    if _beside is None:
        _beside = LocalExecutor(1, timeout).__enter__()
    _beside.submit(None, _in_folder, folder, function, arguments)
    return _beside.next()[1]


def _in_folder(folder: str, function: Callable[..., Any], arguments: tuple[Any, ...]) -> Any:
    try:
        os.chdir(folder)  # names are relative to where the command was typed
    except OSError as error:
        reason = f"{folder}: not there on a machine of the cluster ({error.strerror})"
        return Failure("OSError", reason, fatal=True)
    return function(*arguments)
