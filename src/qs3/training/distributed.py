"""One training on several devices of this machine: processes, and how they meet.

The calling process is device 0. The others are started afresh (``python -m qs3.training.worker``),
which works from a command, a script without a main guard, a notebook and a test alike. They meet
over a file and talk over the loopback interface alone.
"""

import contextlib
import functools
import logging
import os
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import numpy as np
import torch
from lightning_fabric import Fabric
from lightning_fabric.plugins.environments.cluster_environment import ClusterEnvironment
from lightning_fabric.strategies.ddp import DDPStrategy
from lightning_fabric.utilities.exceptions import MisconfigurationException
from torch import Tensor, distributed, nn

from qs3.errors import InputError, QS3Error
from qs3.training.config import TrainSettings

_LOG = logging.getLogger(__name__)
_MEETING = "meeting"
READY = "ready"
"""File that a process makes when it has read its job; its rank follows."""
_GRACE = 60.0
"""Seconds that this process gets to notice by itself that another one has died."""


def make_fabric(settings: TrainSettings, rank: int = 0) -> Fabric:
    """Return the device and number format of the settings.

    Args:
        settings: What to compute on. Several devices compute together inside of `join` only.
        rank: Number of this process's device.

    Raises:
        InputError: where a device is not there, or lacks the number format.
    """
    count = settings.devices
    accelerator = settings.accelerator
    if accelerator == "auto":  # not Lightning's own choice, which may be one without float64
        accelerator = "cuda" if torch.cuda.is_available() else "cpu"
    if settings.precision == "16-mixed" and accelerator == "cpu":
        # Lightning would take bf16 in its place, and the record would tell something else.
        raise InputError("precision 16-mixed needs a GPU; on a CPU take 32-true or bf16-mixed")
    strategy = DDPStrategy(cluster_environment=_OneMachine(rank, count)) if count > 1 else "auto"
    try:
        fabric = Fabric(
            accelerator=accelerator,
            devices=count,
            strategy=strategy,
            precision=settings.precision,
        )
    except (RuntimeError, ValueError, MisconfigurationException) as error:
        reason = " ".join(str(error).split())
        raise InputError(
            f"accelerator {settings.accelerator!r} with devices = {count}: {reason}"
        ) from error
    if settings.precision == "bf16-mixed" and fabric.device.type == "cpu" and not has_bf16_units():
        _tell_of_slow_bf16()
    return fabric


def has_bf16_units() -> bool:
    """Whether this CPU multiplies bfloat16 in hardware; true where PyTorch does not tell."""
    told = getattr(torch.cpu, "get_capabilities", dict)()
    if told.get("architecture") != "x86_64":
        return True
    return bool(told.get("avx512_bf16") or told.get("amx_bf16"))


@functools.cache
def _tell_of_slow_bf16() -> None:
    _LOG.warning(
        "bf16-mixed on a CPU without bf16 units is slower than 32-true, with coarser rounding"
    )


class _OneMachine(ClusterEnvironment):
    """Tells Fabric that somebody else starts the processes, all of them here."""

    def __init__(self, rank: int, world: int) -> None:
        super().__init__()
        self._rank, self._world = rank, world

    @property
    def creates_processes_externally(self) -> bool:
        return True

    @property
    def main_address(self) -> str:
        return "127.0.0.1"

    @property
    def main_port(self) -> int:
        return 0  # never used: the group is made before Fabric looks for one

    @staticmethod
    def detect() -> bool:
        return False

    def world_size(self) -> int:
        return self._world

    def set_world_size(self, size: int) -> None:
        self._world = size

    def global_rank(self) -> int:
        return self._rank

    def set_global_rank(self, rank: int) -> None:
        self._rank = rank

    def local_rank(self) -> int:
        return self._rank

    def node_rank(self) -> int:
        return 0


@contextlib.contextmanager
def join(settings: TrainSettings, rank: int, folder: Path) -> Iterator[Fabric]:
    """Compute together with the other processes that join over the same folder."""
    if distributed.is_initialized():
        raise InputError("this process computes in a group already; set devices to 1")
    fabric = make_fabric(settings, rank)
    cuda = fabric.device.type == "cuda"
    with _environment(_loopback()):
        meeting = str(Path(folder) / _MEETING)
        store = distributed.FileStore(meeting, settings.devices)  # pyright: ignore[reportPrivateImportUsage]
        distributed.init_process_group(
            "nccl" if cuda else "gloo",
            store=store,
            rank=rank,
            world_size=settings.devices,
            device_id=fabric.device if cuda else None,
        )
        try:
            fabric.launch()
            yield fabric
        finally:
            distributed.destroy_process_group()


def _loopback() -> dict[str, str]:
    """Variables that keep the talk off the network; the number of threads is ours to set."""
    names = [name for _, name in socket.if_nameindex()] if hasattr(socket, "if_nameindex") else []
    loop = [name for name in names if name in ("lo", "lo0")]
    there = {"GLOO_SOCKET_IFNAME": loop[0], "NCCL_SOCKET_IFNAME": loop[0]} if loop else {}
    return there | {"OMP_NUM_THREADS": os.environ.get("OMP_NUM_THREADS", "1")}


@contextlib.contextmanager
def _environment(changes: dict[str, str]) -> Iterator[None]:
    """Set environment variables for a while."""
    names = (*changes, "MASTER_ADDR", "MASTER_PORT")
    before = {name: os.environ.get(name) for name in names}
    os.environ.update(changes)
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                os.environ.pop(name, None)
            else:
                os.environ[name] = value


@contextlib.contextmanager
def all_devices(settings: TrainSettings, write_job: Callable[[Path], None]) -> Iterator[Fabric]:
    """Compute on all devices of the settings; this process is the first of them.

    Args:
        settings: How many devices, and which.
        write_job: Writes what the other processes need into a folder; called for several devices
            only. Its files are deleted as soon as all have read them, so that a kill leaves no
            clouds behind.

    Raises:
        InputError: where a device is not there.
        QS3Error: where another process ended before its work was done.
    """
    if settings.devices == 1:
        yield make_fabric(settings)
        return
    with tempfile.TemporaryDirectory(prefix="qs3-") as name:
        folder = Path(name)
        write_job(folder)
        files = list(folder.iterdir())
        others = [_Other(rank, folder) for rank in range(1, settings.devices)]
        try:
            for other in others:
                other.wait_until_ready()
            for file in files:
                with contextlib.suppress(OSError):  # Windows deletes no file that is mapped
                    file.unlink()
            with join(settings, 0, folder) as fabric:
                if fabric.device.type == "cuda":
                    threading.Thread(target=_watch, args=(others,), daemon=True).start()
                yield fabric
            for other in others:
                other.process.wait(_GRACE)
        except (RuntimeError, subprocess.TimeoutExpired) as error:
            fault = _fault(others)
            if fault is None:
                raise
            raise QS3Error(fault) from error
        finally:
            for other in others:
                other.end()


class _Other:
    """A process that computes on another device."""

    def __init__(self, rank: int, folder: Path) -> None:
        self.rank, self.wanted = rank, True
        self.said, self.ready = folder / f"stderr-{rank}", folder / f"{READY}-{rank}"
        paths = os.pathsep.join(path or os.getcwd() for path in sys.path)  # noqa: PTH109
        with self.said.open("wb") as stderr:
            # Its standard input is a lifeline: it ends when this process does.
            self.process = subprocess.Popen(
                [sys.executable, "-m", "qs3.training.worker", str(rank), str(folder)],
                stdin=subprocess.PIPE,
                stdout=subprocess.DEVNULL,
                stderr=stderr,
                env=os.environ | {"PYTHONPATH": paths},
            )

    def wait_until_ready(self) -> None:
        while not self.ready.exists():
            fault = self.fault()
            if fault is not None:
                raise QS3Error(fault)
            time.sleep(0.02)

    def end(self) -> None:
        self.wanted = False
        self.process.kill()
        self.process.wait()
        if self.process.stdin is not None:
            self.process.stdin.close()

    def fault(self) -> str | None:
        """How it failed; None where it did not."""
        code = self.process.poll()
        if not self.wanted or code is None or code == 0:
            return None
        how = f"was killed (signal {-code})" if code < 0 else f"failed (code {code})"
        lines = self.said.read_text("utf-8", "replace").split("\n") if self.said.exists() else []
        last = next((line for line in reversed(lines) if line.strip()), "")
        told = f": {last}" if last and code > 0 else ""
        return (
            f"the process of device {self.rank} {how}{told}; run the same again to go on after the "
            "last finished epoch"
        )


def _fault(others: list[_Other]) -> str | None:
    """Wait a moment for the process that tore the group apart, and say how it ended."""
    for _ in range(50):
        for other in others:
            fault = other.fault()
            if fault is not None:
                return fault
        time.sleep(0.1)
    return None


def _watch(others: list[_Other]) -> None:
    """End this process where another one died and a GPU waits for it without end.

    On a CPU the broken connection is an error at once, and nobody needs to watch.
    """
    while any(other.wanted for other in others):
        fault = next((f for f in (other.fault() for other in others) if f), None)
        if fault is not None:
            time.sleep(_GRACE)
            if any(other.wanted for other in others):
                sys.stderr.write(f"qs3: {fault}\n")
                sys.stderr.flush()
                os._exit(2)
        time.sleep(0.5)


def make_equal(tensors: list[Tensor], fabric: Fabric) -> None:
    """Give every device the first one's values."""
    if fabric.world_size > 1:
        for tensor in tensors:
            distributed.broadcast(tensor, 0)


def make_module_equal(module: nn.Module, fabric: Fabric) -> None:
    """Give every device the first one's parameters and buffers, running statistics included."""
    make_equal([tensor.detach() for tensor in module.state_dict().values()], fabric)


def gather_rows(rows: np.ndarray, mine: slice, count: int, fabric: Fabric) -> np.ndarray:
    """Put the rows that each device computed into one array, the same on all.

    Args:
        rows: This device's rows, float64.
        mine: Their place.
        count: Rows in all.
        fabric: The devices.
    """
    whole = np.zeros((count, *rows.shape[1:]))
    whole[mine] = rows
    if fabric.world_size == 1:
        return whole
    total = fabric.all_reduce(torch.from_numpy(whole).to(fabric.device), reduce_op="sum")
    assert isinstance(total, Tensor)  # noqa: S101
    return total.cpu().numpy()


@contextlib.contextmanager
def threads(settings: TrainSettings) -> Iterator[None]:
    """Compute with the CPU threads of the settings for a while."""
    before = torch.get_num_threads()
    count = settings.threads
    if count is None and settings.devices > 1:
        count = max(1, before // settings.devices)
    if count is not None:
        torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)
