"""Mesh2Point: the simulated active stereo sensor, from rig to fused cloud.

Names load when they are first used: settings and their help need no OpenCV, SciPy or renderer.
"""

from typing import TYPE_CHECKING

from qs3.lazy import handed_on, loader

if TYPE_CHECKING:
    from qs3.sensor.presets import SENSORS as SENSORS
    from qs3.sensor.presets import Sensor as Sensor
    from qs3.sensor.presets import get_sensor as get_sensor
    from qs3.sensor.rig import Pose as Pose
    from qs3.sensor.rig import Region as Region
    from qs3.sensor.rig import StereoRig as StereoRig

__getattr__ = loader(__name__, handed_on(__file__))
