"""Rendering of a scene: the protocol of renderers and what they return."""

from qs3.sensor.render.scene import Body as Body
from qs3.sensor.render.scene import LightSettings as LightSettings
from qs3.sensor.render.scene import Renderer as Renderer
from qs3.sensor.render.scene import Scene as Scene
from qs3.sensor.render.scene import StereoPair as StereoPair
