"""``qs3 segment``: the objects of a table or a floor, one cloud each."""

from pathlib import Path
from typing import Annotated

import tyro

from qs3.cli.options import Flat
from qs3.cli.text import columns, quoted, show, tell
from qs3.io.extract.segment import TABLE, SceneSettings, segment_scene


def segment(
    scene: Annotated[Path, tyro.conf.Positional],
    out: Path,
    settings: Flat[SceneSettings] = SceneSettings(),  # noqa: B008
) -> int:
    """Cut a scan of a table or a floor into the objects that stand on it.

    Args:
        scene: A cloud in metres (PLY, PCD, XYZ, NPY, NPZ); with --intrinsics a depth image (16-bit
            PNG, TIFF, npy).
        out: New folder for a PLY file an object, z up in metres, and objects.csv.
        settings: How it is cut.
    """
    objects = segment_scene(scene, out, settings)
    rows = [["object", "points", "x", "y", "length", "width", "height", "heading"]]
    for number, item in enumerate(objects):
        numbers = [f"{value:.3f}" for value in (*item.centre[:2], *item.size)]
        name, count = f"object_{number:03d}", str(len(item.points))
        rows.append([name, count, *numbers, f"{item.heading:.0f}°"])
    show(*columns(rows, 1))
    following = f"qs3 predict RUN {quoted(out)}"
    tell(f"{len(objects)} objects in {out}, in metres; see {TABLE}. Next: {following}")
    return 0
