"""Clouds that are too many for memory, in temporary files that the system maps and forgets."""

import os
import tempfile
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from functools import cached_property
from typing import Any

import numpy as np
from jaxtyping import Float

from qs3.errors import InputError

LARGE = 2**30
"""Bytes of clouds from which on they are kept on the disk."""


def scratch_array(shape: tuple[int, ...], dtype: Any = np.float32) -> np.ndarray:
    """Return an array to be filled: in memory, or a large one in a file that has no name.

    Raises:
        InputError: where the disk has no room for it.
    """
    size = int(np.prod(shape)) * np.dtype(dtype).itemsize
    if size < LARGE:
        return np.empty(shape, dtype)
    with _room(), tempfile.TemporaryFile() as file:
        if hasattr(os, "posix_fallocate"):  # a full disk would end the process when it is written
            os.posix_fallocate(file.fileno(), 0, size)
        return np.memmap(file, dtype, "w+", shape=shape)


class Spool(Sequence):
    """Clouds of any sizes one behind another in a file that has no name; read when asked for."""

    def __init__(self) -> None:
        self._file = tempfile.TemporaryFile()  # noqa: SIM115 - closed when it is mapped
        self._ends = [0]

    def extend(self, clouds: Iterable[Float[np.ndarray, "_ 3"]]) -> None:
        """Write clouds behind the others, before the first is read.

        Raises:
            InputError: where the disk is full.
        """
        with _room():
            for cloud in clouds:
                self._file.write(np.ascontiguousarray(cloud, np.float32).data)
                self._ends.append(self._ends[-1] + len(cloud))

    @cached_property
    def points(self) -> Float[np.ndarray, "n 3"]:
        """All points of all clouds."""
        with _room(), self._file:
            self._file.flush()
            return np.memmap(self._file, np.float32, "r", shape=(self._ends[-1], 3))

    def __len__(self) -> int:
        return len(self._ends) - 1

    def __getitem__(self, index: Any) -> Any:
        if isinstance(index, slice):
            return [self[place] for place in range(*index.indices(len(self)))]
        place = range(len(self))[index]
        return self.points[self._ends[place] : self._ends[place + 1]]


@contextmanager
def _room() -> Iterator[None]:
    try:
        yield
    except OSError as error:
        raise InputError(
            f"{tempfile.gettempdir()}: no room for clouds that memory should not hold ({error}); "
            "name another folder by TMPDIR"
        ) from error
