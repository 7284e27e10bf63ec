"""How many processors this process may use, and how many threads its user asks for."""

import os


def usable_processors() -> int:
    """Count the processors that this process may run on.

    Example:
        >>> usable_processors() > 0
        True
    """
    affinity = getattr(os, "sched_getaffinity", None)
    return len(affinity(0)) if affinity is not None else os.cpu_count() or 1


def asked_threads() -> int | None:
    """Read ``OMP_NUM_THREADS``, for libraries that do not; None where it is no number above 0."""
    wanted = os.environ.get("OMP_NUM_THREADS", "")
    return int(wanted) or None if wanted.isdigit() else None
