"""Sensors as frozen settings: built-in ones by name, and TOML files of the user's own.

``paper`` holds the values of the released scanner; the real cameras are in metres.
"""

from qs3.sensor.presets.settings import Sensor as Sensor
from qs3.sensor.presets.settings import changed as changed
from qs3.sensor.presets.settings import settings_dict as settings_dict
from qs3.sensor.presets.toml_file import SENSORS as SENSORS
from qs3.sensor.presets.toml_file import get_sensor as get_sensor
from qs3.sensor.presets.toml_file import load_sensor as load_sensor
from qs3.sensor.presets.toml_file import sensor_name as sensor_name
from qs3.sensor.presets.toml_file import sensor_toml as sensor_toml
