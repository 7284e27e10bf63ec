"""The number of CPU threads of a training.

Another number of threads gives other last bits, as sums are split elsewhere. So the number follows
from the settings and the machine alone, and a run keeps it.
"""

import contextlib
import ctypes
import logging
import os
import platform
import sys
from collections.abc import Iterator

import torch

from qs3.training.config import TrainSettings

_LOG = logging.getLogger(__name__)
_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3
"""Numbers of two options in glibc's malloc.h."""
_LARGEST_KEPT, _MOST_KEPT = 2**25, 2**29
"""Bytes: arrays up to the one (glibc takes no more) come from memory that is kept; of it at most
the other lies idle."""


def choose_threads(settings: TrainSettings, begun: int | None) -> int:
    """Return the number of CPU threads of a training.

    It is the setting; without one, the number that the run was begun with; else PyTorch's number:
    ``OMP_NUM_THREADS``, or that of the cores.

    Args:
        settings: How to train.
        begun: Number that the run was begun with; None for a new one.
    """
    asked = settings.threads
    if asked is None:
        return begun or torch.get_num_threads()
    if begun not in (None, asked):
        _LOG.warning(
            "this run began with threads = %d and continues with %d: its last bits may differ "
            "from those of a run that never stopped",
            *(begun, asked),
        )
    return asked


def keep_memory() -> None:
    """Let glibc's allocator keep freed memory.

    By default each large array is mapped again, page by page, which takes a third of the time of a
    PointNet step. Environment variables win.
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
    """Set the number of CPU threads within the context."""
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
