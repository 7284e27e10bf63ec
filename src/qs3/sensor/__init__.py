"""Mesh2Point: the simulated active stereo sensor, from rig to fused cloud."""

from qs3.sensor.presets import SENSORS as SENSORS
from qs3.sensor.presets import Sensor as Sensor
from qs3.sensor.presets import load_sensor as load_sensor
from qs3.sensor.rig import Pose as Pose
from qs3.sensor.rig import Region as Region
from qs3.sensor.rig import StereoRig as StereoRig
