"""What a data set will take, before it is made."""

import collections
import time
from dataclasses import dataclass
from typing import Any

import numpy as np

from qs3.errors import InputError
from qs3.store.executors import Failure, LocalExecutor
from qs3.store.plan import Plan
from qs3.store.scan_item import scan_item
from qs3.store.shards import DType, shard_bytes, table_of


@dataclass(frozen=True)
class Estimate:
    """Counts, and costs measured on a few scans of the list."""

    objects: dict[str, int]
    """Objects by class, and by split where there are splits."""
    rows: int
    """Scans in all."""
    part_rows: int
    """Scans of the part asked for."""
    bytes: float
    """Size of the part's shards."""
    seconds: float
    """Time of the part with one worker."""
    measured: int
    """Scans that this was measured on."""


def estimate(
    plan: Plan, part: tuple[int, int] = (0, 1), scans: int = 3, timeout: float | None = None
) -> Estimate:
    """Scan a few objects, spread over the list, and multiply.

    Args:
        plan: The work.
        part: ``(i, n)``, as in `generate`.
        timeout: Seconds that one scan may take; None waits for ever.
        scans: Objects to scan, one after another in one worker, after one more to warm up.

    Raises:
        InputError: where none of them can be scanned.
    """
    objects: collections.Counter[str] = collections.Counter()
    for item in plan.items:
        objects[" ".join(filter(None, (item.class_name, item.split)))] += 1
    chosen = np.linspace(0, len(plan.items) - 1, min(scans, len(plan.items))).astype(int).tolist()
    sizes: list[int] = []
    seconds: list[float] = []
    failure: Failure | None = None
    with LocalExecutor(1, timeout) as executor:
        for index in [chosen[0], *chosen]:  # the first scan of a process compiles and loads
            executor.submit(index, _timed, plan.arguments(index, 0), plan.settings.dtype)
            outcome = executor.next()[1]
            if isinstance(outcome, Failure):
                failure = outcome
            else:
                seconds.append(outcome[0])
                sizes.append(outcome[1])
    if not sizes:
        raise InputError(
            f"none of {len(chosen)} scans tried succeeded: {failure and failure.reason}"
        )
    rows = sum(len(list(plan.places(shard))) for shard in range(part[0], plan.shards, part[1]))
    kept = slice(1, None) if len(seconds) > 1 else slice(None)
    return Estimate(
        objects=dict(sorted(objects.items())),
        rows=plan.rows,
        part_rows=rows,
        bytes=rows * float(np.mean(sizes)),
        seconds=rows * float(np.mean(seconds[kept])),
        measured=len(seconds[kept]),
    )


def _timed(arguments: tuple[Any, ...], dtype: DType) -> tuple[float, int]:
    start = time.perf_counter()
    size = len(shard_bytes(table_of([scan_item(*arguments)], dtype)))
    return time.perf_counter() - start, size
