"""Meshes: read from files, brought to one size, or made on the spot."""

from qs3.meshes.classes import POINTDA10 as POINTDA10
from qs3.meshes.classes import canonical as canonical
from qs3.meshes.collections import MeshItem as MeshItem
from qs3.meshes.collections import collect as collect
from qs3.meshes.loading import EXTENSIONS as EXTENSIONS
from qs3.meshes.loading import load_mesh as load_mesh
from qs3.meshes.normalising import normalise as normalise
from qs3.meshes.normalising import sample_surface as sample_surface
