"""Meshes: read from files, brought to size, or made on the spot."""

from qs3.meshes import shapes as shapes
from qs3.meshes.normalise import normalise as normalise
from qs3.meshes.normalise import sample_surface as sample_surface
