"""One training on several devices of this machine: processes, and how they meet.

The calling process is device 0. The others are started afresh, from a command, a script without a
main guard, a notebook and a test alike: Lightning's launchers need such a guard, or make the
calling process wait while another one trains. They meet over a file and talk over the loopback
interface alone.
"""

import contextlib
import os
import signal
import socket
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import torch
from lightning_fabric import Fabric
from lightning_fabric.plugins.environments.lightning import LightningEnvironment
from lightning_fabric.strategies.ddp import DDPStrategy
from lightning_fabric.utilities.exceptions import MisconfigurationException
from torch import Tensor, distributed
from torch.multiprocessing.spawn import (
    ProcessContext,
    ProcessException,
    ProcessExitedException,
    start_processes,
)

from qs3.errors import InputError, QS3Error, say_once
from qs3.processors import script_hidden
from qs3.store.executors.local import end_with_parent
from qs3.training.config import TrainSettings
from qs3.training.progress import TimeUpError
from qs3.training.threads import threads

_GRACE = 60.0
"""Seconds that this process gets to notice by itself that another one has died."""

Work = Callable[[Fabric], Any]
"""What every device does; it must be picklable for several."""


def make_fabric(settings: TrainSettings, rank: int = 0) -> Fabric:
    """Return the device and number format of the settings.

    Args:
        settings: What to compute on. Several devices compute together inside of `all_devices` only.
        rank: Number of this process's device.

    Raises:
        InputError: where a device is not there, or lacks the number format.
    """
    count = settings.devices
    accelerator = settings.accelerator
    if accelerator == "auto":  # not Lightning's own choice, which may be one without float64
        accelerator = "cuda" if torch.cuda.is_available() else "cpu"
    if accelerator == "cuda" and (seen := torch.cuda.device_count()) < count:
        raise InputError(
            f"accelerator 'cuda' with devices = {count}: PyTorch sees {seen or 'no'} NVIDIA GPU"
            f"{'s' * (seen > 1)} here; take --accelerator cpu or fewer --devices (qs3 doctor tells)"
        )
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
        say_once(
            "bf16-mixed on a CPU without bf16 units is slower than 32-true, with coarser rounding"
        )
    return fabric


def has_bf16_units() -> bool:
    """Whether this CPU multiplies bfloat16 in hardware; true where PyTorch does not tell."""
    capabilities = getattr(torch.cpu, "get_capabilities", dict)()
    if capabilities.get("architecture") != "x86_64":
        return True
    return bool(capabilities.get("avx512_bf16") or capabilities.get("amx_bf16"))


class _OneMachine(LightningEnvironment):
    """Tells Fabric that somebody else starts the processes, all of them here."""

    def __init__(self, rank: int, world: int) -> None:
        super().__init__()
        self._global_rank, self._world_size = rank, world
        self._main_port = 0  # never used: the group is made before Fabric looks for one

    @property
    def creates_processes_externally(self) -> bool:
        return True

    def local_rank(self) -> int:
        return self._global_rank

    def node_rank(self) -> int:
        return 0


@contextlib.contextmanager
def _joined(settings: TrainSettings, rank: int, folder: str) -> Iterator[Fabric]:
    """Compute together with the other processes that join over the same folder."""
    if distributed.is_initialized():
        raise InputError("this process computes in a group already; set devices to 1")
    fabric = make_fabric(settings, rank)
    cuda = fabric.device.type == "cuda"
    with mock.patch.dict(os.environ, _loopback()):  # puts all of it back
        meeting = str(Path(folder) / "meeting")
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
    talk = {"GLOO_SOCKET_IFNAME": loop[0], "NCCL_SOCKET_IFNAME": loop[0]} if loop else {}
    return talk | {"OMP_NUM_THREADS": os.environ.get("OMP_NUM_THREADS", "1")}


@contextlib.contextmanager
def all_devices(settings: TrainSettings, work: Work) -> Iterator[Fabric]:
    """Compute on all devices of the settings; this process is the first of them.

    Args:
        settings: How many devices, and which.
        work: What the others do; the caller does the same with the devices that it is handed.

    Raises:
        InputError: where a device is not there.
        QS3Error: where another process ended before its work was done.
    """
    if settings.devices == 1:
        yield make_fabric(settings)
        return
    faults: list[str] = []
    with tempfile.TemporaryDirectory(prefix="qs3-") as folder:
        others = _start(settings, work, folder)

        def failed(seconds: float) -> bool:
            """Whether one of the others failed, now or within some seconds."""
            try:
                others.join(seconds)
            except ProcessException as error:
                faults.append(_fault(error))
            return bool(faults)

        def watch() -> None:
            """End this process where another one died and a GPU waits for it without end."""
            while not failed(0.5):
                if not others.sentinels:
                    return
            time.sleep(_GRACE)
            sys.stderr.write(f"qs3: {faults[0]}\n")
            sys.stderr.flush()
            os._exit(2)

        try:
            while len(list(Path(folder).glob("ready-*"))) < settings.devices - 1:
                if failed(0.1):
                    raise QS3Error(faults[0])
            with _joined(settings, 0, folder) as fabric:
                # On a CPU the broken connection is an error at once: nobody needs to watch.
                if fabric.device.type == "cuda":
                    threading.Thread(target=watch, daemon=True).start()
                yield fabric
            for process in others.processes:
                process.join(_GRACE)
        except RuntimeError as error:
            if not failed(20.0):  # on a busy machine it takes its time to end
                raise
            raise QS3Error(faults[0]) from error
        finally:
            for process in others.processes:
                process.kill()
                process.join()


def _start(settings: TrainSettings, work: Work, folder: str) -> ProcessContext:
    """Start the other processes."""
    with script_hidden():
        count, arguments = settings.devices - 1, (folder, settings, work)
        context = start_processes(_do, arguments, count, join=False, daemon=True)
        assert context is not None  # noqa: S101
        return context


def _fault(error: ProcessException) -> str:
    """Say in a line which process ended how."""
    how = f"failed: {str(error).strip().splitlines()[-1].removeprefix('qs3.errors.')}"
    if isinstance(error, ProcessExitedException):
        code = error.exit_code
        how = f"was killed (signal {-code})" if code < 0 else f"failed (code {code})"
    return (
        f"the process of device {error.error_index + 1} {how}; run the same again to go on after "
        "the last finished epoch"
    )


def _do(index: int, folder: str, settings: TrainSettings, work: Work) -> None:
    """Work on one further device, with the processes that meet in the folder."""
    # Ctrl-C reaches every process of a terminal: the first decides, and ends this one.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    end_with_parent()
    silence = os.open(os.devnull, os.O_WRONLY)
    for stream in (1, 2):  # the first process talks
        os.dup2(silence, stream)
    (Path(folder) / f"ready-{index}").touch()
    with (
        contextlib.suppress(TimeUpError),
        threads(int(settings.threads or 1)),
        _joined(settings, index + 1, folder) as fabric,
    ):
        work(fabric)


def make_equal(tensors: Iterable[Tensor], fabric: Fabric) -> None:
    """Give every device the first one's values."""
    if fabric.world_size > 1:
        for tensor in tensors:
            distributed.broadcast(tensor.detach(), 0)


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
