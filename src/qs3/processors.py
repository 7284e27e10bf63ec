"""Processors and threads that this process may use, and its script."""

import contextlib
import os
import sys
import types
from collections.abc import Iterator


def usable_processors() -> int:
    """Count the processors that this process may run on."""
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity is not None else os.cpu_count() or 1


def wanted_threads() -> int | None:
    """Read ``OMP_NUM_THREADS``, for libraries that do not; None if it is no number above 0."""
    wanted = os.environ.get("OMP_NUM_THREADS", "")
    return int(wanted) or None if wanted.isdigit() else None


@contextlib.contextmanager
def script_hidden() -> Iterator[None]:
    """Hide the caller's script from processes that are spawned meanwhile: each would run it again.

    So a script needs no ``if __name__ == "__main__"``; what it defines cannot be sent to them.
    """
    main = sys.modules["__main__"]
    sys.modules["__main__"] = types.ModuleType("__main__")
    try:
        yield
    finally:
        sys.modules["__main__"] = main
