"""Ten tests of a simulated depth camera against what real ones are known to do."""

from qs3.sensor.realism.run import LAWS as LAWS
from qs3.sensor.realism.run import RealismSettings as RealismSettings
from qs3.sensor.realism.run import realism as realism
