"""Six laws of real depth cameras, measured on a simulated one; and its matcher on a real pair."""

from qs3.sensor.realism.run import LAWS as LAWS
from qs3.sensor.realism.run import RealismSettings as RealismSettings
from qs3.sensor.realism.run import realism as realism
