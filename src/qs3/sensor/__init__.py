"""Mesh2Point: the simulated active stereo sensor, from rig to fused cloud.

In the order of light: `stage` (object, surroundings, what is drawn at random), `light` (pattern,
materials, renderer), `exposure` (grey levels and their noise), `matching` (disparity), `depth`
(points), `fusion` (of views into one cloud), and `scan`, which does all of it. `placement` puts the
camera. Settings have the defaults of the paper; the numbers of each camera are in
``presets/cameras.toml``.
"""

from qs3.sensor.presets import SENSORS as SENSORS
from qs3.sensor.presets import Sensor as Sensor
from qs3.sensor.presets import load_sensor as load_sensor
from qs3.sensor.rig import Pose as Pose
from qs3.sensor.rig import Region as Region
from qs3.sensor.rig import StereoRig as StereoRig
