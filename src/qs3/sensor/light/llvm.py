"""Search for LLVM, the compiler of Mitsuba's fast variant on a CPU."""

import ctypes.util
import functools
import importlib.metadata
import os
from pathlib import Path

_VARIABLE = "DRJIT_LIBLLVM_PATH"
_WHEEL = "karellen-llvm-core"


@functools.cache
def find_llvm() -> str | None:
    """Return the library that Dr.Jit is to load, or None for its own search.

    In this order: the variable ``DRJIT_LIBLLVM_PATH``; the system's libLLVM 19; the library of the
    wheel that the extra ``llvm`` installs. Other versions of the system are not trusted: 14 and 15
    abort the process on some processors.
    """
    if _VARIABLE in os.environ:
        return os.environ[_VARIABLE] or None
    if ctypes.util.find_library("LLVM-19"):
        return None
    try:
        files = importlib.metadata.files(_WHEEL) or []
    except importlib.metadata.PackageNotFoundError:
        return None
    library = next((file for file in files if file.name.startswith("libLLVM.so")), None)
    path = None if library is None else Path(str(library.locate())).resolve()
    return str(path) if path is not None and path.is_file() else None


def point_to_llvm() -> None:
    """Set ``DRJIT_LIBLLVM_PATH`` for this process and its children, before Dr.Jit is loaded."""
    if path := find_llvm():
        os.environ.setdefault(_VARIABLE, path)
