"""The pictures of a scan, gathered for its montage."""

from typing import Any

import numpy as np


def montage_view(result: Any, sensor: Any) -> tuple[Any, int]:
    """The view that shows most of the object, as `qs3.report.MontageView`, and its index.

    Args:
        result: A `qs3.Scan` made with ``keep_images``.
        sensor: The `qs3.Sensor` that made it.
    """
    from qs3.report.montage import MontageView, object_box
    from qs3.sensor.speckle import pattern_image

    best = int(np.argmax([view.object_pixels for view in result.views]))
    images = result.images[best]
    true_depth = np.where(images.mask, images.true_depth, np.nan)  # of the object alone
    view = MontageView(
        left=images.left,
        right=images.right,
        disparity=images.disparity,
        depth=images.depth,
        true_depth=true_depth,
        cloud=result.points,
        clean=result.clean,
        pattern=pattern_image(sensor.pattern),
        box=object_box(true_depth, 20),
    )
    return view, best
