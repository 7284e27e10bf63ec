"""How many CPU threads a training takes.

Networks give other bits with other numbers of threads, as sums are cut elsewhere. So the number
follows from the settings and the machine alone, and is kept with the run; what fits a machine that
is busy is found by timing, but only where ``auto`` asks for it.
"""

import contextlib
import ctypes
import logging
import os
import platform
import statistics
import sys
import time
from collections.abc import Callable, Iterator

import torch
from lightning_fabric import Fabric

from qs3.adaptation import Batch, Method
from qs3.training.config import TrainSettings

_LOG = logging.getLogger(__name__)
_ROUNDS = 6
"""Most times that each number of threads is timed; the first is not counted."""
_SECONDS = 10.0
"""After so long each number is timed no more than it has been, but twice at least."""
_GAIN = 0.95
"""More threads must bring a step below this share of the time that fewer take."""
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3
"""Numbers of two options in glibc's malloc.h."""
_LARGEST_KEPT, _MOST_KEPT = 2**25, 2**29
"""Bytes: arrays up to the one (glibc takes no more) come from memory that is kept; of it at most
the other lies idle."""


def choose_threads(
    settings: TrainSettings, begun: int | None, step: Callable[[], Callable[[], None]] | None
) -> int:
    """Return the number of CPU threads for each process of a training.

    What is asked for; else what the run was begun with; else PyTorch's number, which is that of the
    cores or ``OMP_NUM_THREADS``, or one for each of several processes; with ``auto`` the number
    with which a step is fastest now.

    Args:
        settings: How to train.
        begun: Number that the run was begun with; None for a new one.
        step: Makes a step to be timed; without one ``auto`` is as None.
    """
    asked = settings.threads
    if isinstance(asked, int):
        if begun not in (None, asked):
            _LOG.warning(
                "this run was begun with threads = %d and goes on with %d: its last bits may "
                "differ from those of a run that never stopped",
                *(begun, asked),
            )
        return asked
    if begun is not None:
        return begun
    if settings.devices > 1:
        return 1
    most = torch.get_num_threads()
    return most if asked is None or step is None else fastest(step(), most)


def fastest(step: Callable[[], None], most: int) -> int:
    """Return with how many threads, 1, 2, 4 … ``most``, a step takes the least time here and now.

    The numbers take turns, so that all meet the same neighbours on a busy machine. The fewer win
    where more bring hardly anything.
    """
    counts = sorted({*(2**power for power in range(most.bit_length()) if 2**power < most), most})
    seconds: dict[int, list[float]] = {count: [] for count in counts}
    began = time.perf_counter()
    for number in range(_ROUNDS if len(counts) > 1 else 0):
        if number > 1 and time.perf_counter() - began > _SECONDS:
            break
        for count in counts:
            with threads(count):
                start = time.perf_counter()
                step()
                seconds[count].append(time.perf_counter() - start)
    best = counts[0]
    for count in counts[1:]:
        if statistics.median(seconds[count][1:]) < _GAIN * statistics.median(seconds[best][1:]):
            best = count
    return best


def trial_step(
    method: Method, classes: int, settings: TrainSettings, fabric: Fabric
) -> Callable[[], None]:
    """Return a step like those of the training, on clouds drawn here.

    Args:
        method: Is spoilt: its batch statistics move. Give one that is not needed any more.
        classes: Number of classes.
        settings: Size of a batch and of its clouds.
        fabric: Device and number format.
    """
    wrapped = fabric.setup_module(method)
    generator = torch.Generator().manual_seed(0)
    shape = (settings.batch_size, settings.num_points, 3)
    points, other = (torch.randn(shape, generator=generator).to(fabric.device) for _ in range(2))
    labels = torch.arange(len(points), device=fabric.device) % classes
    batch = Batch(points, labels, (len(points),))

    def step() -> None:
        method.train()
        with torch.random.fork_rng(devices=[]):
            losses = wrapped(batch, other if method.uses_target else None, 0.0, generator)
            fabric.backward(torch.stack([term.float() for term in losses.values()]).sum())

    return step


def keep_memory() -> None:
    """Let the allocator keep what this process gives back, where that is glibc's.

    By default each large array comes anew from the system, page by page, which takes a third of
    the time of a PointNet step; nothing else changes. What the environment says stays.
    """
    if sys.platform != "linux" or platform.libc_ver()[0] != "glibc":
        return
    if any(name.startswith("MALLOC_") for name in os.environ):
        return
    mallopt = ctypes.CDLL(None).mallopt
    mallopt(_M_MMAP_THRESHOLD, _LARGEST_KEPT)
    mallopt(_M_TRIM_THRESHOLD, _MOST_KEPT)


@contextlib.contextmanager
def threads(count: int) -> Iterator[None]:
    """Compute with so many CPU threads for a while, with memory at hand."""
    keep_memory()
    before = torch.get_num_threads()
    torch.set_num_threads(count)
    try:
        yield
    finally:
        torch.set_num_threads(before)


def describe_threads() -> str:
    """Say in a line with how many threads a training computes here, and what is set about them.

    Example:
        >>> "GOMP_SPINCOUNT" in describe_threads()
        True
    """
    count = torch.get_num_threads()
    names = ("OMP_NUM_THREADS", "OMP_WAIT_POLICY", "GOMP_SPINCOUNT")
    said = ", ".join(f"{name} {os.environ.get(name, 'not set')}" for name in names)
    return f"{count} CPU thread{'s' if count > 1 else ''} unless --threads says otherwise ({said})"
