"""The ten laws by id: in short, and the function that photographs and judges."""

from collections.abc import Callable

from qs3.sensor.realism import edges, faces, kinect, surfaces, walls
from qs3.sensor.realism.bench import Bench
from qs3.sensor.realism.rows import Judged

LAWS: dict[str, tuple[str, Callable[[Bench], Judged | str]]] = {
    "T1": ("RMS grows with the square of the distance", walls.noise),
    "T2": ("No bias of disparity or distance", walls.bias),
    "T3": ("Disparities come in the preset's steps", walls.steps),
    "T4": ("Left band and occlusion shadow as wide as geometry says", edges.bands),
    "T5": ("Edges fatten by no more than half a block", edges.edges),
    "T6": ("Walls are filled; dark and glancing ones less", surfaces.fill),
    "T7": ("No depth on a mirror or clear glass", surfaces.clear),
    "T8": ("Steps and noise of the Kinect as measured", kinect.kinect),
    "T9": ("Image noise changes depth, equal seeds repeat it", walls.repeats),
    "T10": ("Distances from a scanned object follow the law", faces.scanned),
}
"""Title, and test: figures beside their bounds and curves, or why the law does not apply."""
