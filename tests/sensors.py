"""A camera of its own for tests that need whole frames."""

from qs3.sensor.depth import DepthSettings
from qs3.sensor.light.pattern import PatternSettings
from qs3.sensor.matching import MatchingSettings
from qs3.sensor.placement import Placement
from qs3.sensor.presets import Sensor
from qs3.sensor.rig import StereoRig

METRIC = Sensor(
    name="metric",
    rig=StereoRig(width=400, height=300, focal=420.0, baseline=0.09),
    pattern=PatternSettings(columns=177, rows=138),
    matching=MatchingSettings(num_disparities=64, block_size=11),
    depth=DepthSettings(near=0.3, far=3.0, stride=1),
    placement=Placement(radius=(1.0, 1.2)),
    object_size=0.5,
)
"""In metres, before an object of 0.5 m."""
