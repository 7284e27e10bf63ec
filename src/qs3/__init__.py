"""CAD models to a classifier that works on a real depth camera, with no label from that camera.

The parts that need no PyTorch load at once; the rest is in `qs3.models`, `qs3.training` and
`qs3.adaptation`.
"""

from importlib.metadata import version as _version

from qs3.meshes import load_mesh as load_mesh
from qs3.meshes import shapes as shapes
from qs3.sensor.presets import Sensor as Sensor
from qs3.sensor.rig import Pose as Pose
from qs3.sensor.rig import StereoRig as StereoRig
from qs3.sensor.scan import Scan as Scan
from qs3.sensor.scan import scan as scan

__version__ = _version("qs3")
