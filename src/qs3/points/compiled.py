"""Functions compiled by numba on first use and cached on disk.

On one core: 0.5 s to import numba, 0.1 s to load the cache, 7 s to compile the matcher once.
Functions are serial and never reorder sums: the same bytes on any number of threads.
"""

import inspect
from collections.abc import Callable
from typing import Any

from qs3.errors import CannotCompileError


def compiled(function: Callable[..., Any]) -> Callable[..., Any]:
    """Compile a function of arrays and numbers.

    If neither the folder of the module nor the user's own can be written, what is compiled lives as
    long as the process; the environment variable NUMBA_CACHE_DIR names another folder.
    """
    plain = inspect.unwrap(function)  # of the checks of types that tests put around it
    try:
        from numba import njit

        try:
            return njit(cache=True, nogil=True, error_model="numpy")(plain)
        except RuntimeError:  # no place for the cache
            return njit(nogil=True, error_model="numpy")(plain)
    except Exception as error:
        reason = str(error).splitlines()[0] if str(error) else type(error).__name__
        raise CannotCompileError(
            f"this machine cannot compile ({reason}), as {function.__module__} needs it; install "
            "numba and llvmlite in the versions of constraints.txt"
        ) from error
