"""CAD models to a classifier that works on a real depth camera, with no label from that camera.

The names that a script needs first load when they are first used: a table waits for no renderer.
"""

import importlib
import os
from typing import TYPE_CHECKING, Any

from qs3.lazy import PACKAGES, loader

if TYPE_CHECKING:
    from qs3 import shapes as shapes
    from qs3.answers.classifier import Classifier as Classifier
    from qs3.answers.classifier import load as load
    from qs3.meshes import load_mesh as load_mesh
    from qs3.sensor.presets import Sensor as Sensor
    from qs3.sensor.presets import load_sensor as load_sensor
    from qs3.sensor.rig import Pose as Pose
    from qs3.sensor.rig import StereoRig as StereoRig
    from qs3.sensor.scan import Scan as Scan
    from qs3.sensor.scan import scan as scan
    from qs3.workflow.adapt import adapt as adapt

# OpenMP's threads, which PyTorch loads with, spin while they wait for one another. Beside another
# busy program the wait is long, and training keeps a quarter of its rate or less; brief spinning
# costs nothing on an idle machine. Read once, when PyTorch is first imported.
os.environ.setdefault("GOMP_SPINCOUNT", "1000")

PACKAGES += ["qs3.paper.names", "qs3.paper.data"]  # the rooms below the paper do not know it

_load = loader("qs3", "__version__")


def __getattr__(name: str) -> Any:
    if name == "shapes":
        return importlib.import_module("qs3.shapes")
    if name == "__version__":
        from importlib.metadata import version

        return version("qs3")
    return _load(name)
