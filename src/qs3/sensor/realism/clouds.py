"""Strays beyond an object that was scanned in a room (T11)."""

from collections.abc import Sequence

import numpy as np

from qs3.sensor.realism.bench import Bench
from qs3.sensor.realism.rows import Row, row
from qs3.sensor.statistics import radius_ratio

REAL = {0.05: 0.40, 0.25: 0.60, 0.50: 0.70}
"""Least `radius_ratio` by quantile. Single-view objects of three real sets have 0.40 to 0.66, 0.58
to 0.76 and 0.69 to 0.80 (NYU Depth v2, SUN RGB-D, ScanNet)."""


def strays(bench: Bench) -> list[Row]:
    """T11: one view of objects of all ten classes in a room, cut out by their masks."""
    from qs3 import shapes
    from qs3.sensor.scan import scan

    ratios = []
    for index in range((1 if bench.quick else 4) * len(shapes.CLASSES)):
        number, label = divmod(index, len(shapes.CLASSES))
        made = scan(
            shapes.make(shapes.CLASSES[label], seed=number),
            sensor=bench.sensor,
            renderer=bench.renderer,
            views=1,
            scene="room",
            crop="mask",
            seed=bench.seed + index,
        )
        ratios.append(radius_ratio(made.points))
    return ratio_rows(ratios)


def ratio_rows(ratios: Sequence[float]) -> list[Row]:
    """Judge the radius ratios of scans."""
    return [
        row(f"radius ratio, {100 * share:.0f} % quantile", np.quantile(ratios, share), least)
        for share, least in REAL.items()
    ]
