"""Data of benchmarks: layouts, which `qs3.lazy.load_names` makes known, and scans to cut."""

from qs3.clouds.layouts import FORMATS
from qs3.paper.data import hdf5, modelnet_normal, pointda10

FORMATS |= {layout.FORMAT.name: layout.FORMAT for layout in (hdf5, modelnet_normal, pointda10)}
