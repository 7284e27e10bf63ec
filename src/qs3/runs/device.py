"""Device, number format, CPU threads and random state of a training.

Another number of threads gives other last bits, as sums are split elsewhere. So the number follows
from the settings and the machine alone, and a run keeps it.
"""

import contextlib
import ctypes
import os
import platform
import sys
from collections.abc import Iterator

import torch

from qs3.errors import InputError
from qs3.runs.settings import Precision, TrainSettings

_M_TRIM_THRESHOLD, _M_MMAP_THRESHOLD = -1, -3  # options in glibc's malloc.h
_LARGEST_KEPT, _MOST_KEPT = 2**25, 2**29
"""Bytes: arrays up to the one (glibc takes no more) come from memory that is kept; of it at most
the other lies idle."""


def choose_device(settings: TrainSettings) -> torch.device:
    """Return the device that the settings name."""
    name, has_gpu = settings.accelerator, torch.cuda.is_available()
    if name == "auto":
        name = "cuda" if has_gpu else "cpu"
    if name == "cuda" and not has_gpu:
        raise InputError(
            "accelerator 'cuda': PyTorch sees no NVIDIA GPU here; use --accelerator cpu "
            "(qs3 doctor shows the devices)"
        )
    return torch.device(name)


def autocast(device: torch.device, precision: Precision) -> torch.autocast:
    """Return a context that computes in the number format; it does nothing for 32-true."""
    return torch.autocast(device.type, torch.bfloat16, enabled=precision == "bf16-mixed")


def keep_memory() -> None:
    """Let glibc's allocator keep freed memory.

    By default each large array is mapped again, page by page, which takes a third of the time of a
    PointNet step. Environment variables win.
    """
    glibc = sys.platform == "linux" and platform.libc_ver()[0] == "glibc"
    if glibc and not any(name.startswith("MALLOC_") for name in os.environ):
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


@contextlib.contextmanager
def seeded(seed: int, device: torch.device | None = None) -> Iterator[None]:
    """Seed PyTorch within the context, on the CPU and on a GPU that is named."""
    gpus = [device.index or 0] if device is not None and device.type == "cuda" else []
    with torch.random.fork_rng(devices=gpus):
        torch.manual_seed(seed)
        yield
