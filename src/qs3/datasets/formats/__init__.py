"""Readers and writers of the data sets of this field, one file a layout."""

from qs3.datasets.formats import (
    archive,
    graspnet,
    modelnet_h5,
    modelnet_meshes,
    point_folders,
    pointda10,
    scanobjectnn,
    store_format,
    xyz_trees,
)
from qs3.datasets.formats.format import Format as Format

FORMATS: dict[str, Format] = {
    layout.name: layout
    for layout in (
        store_format.FORMAT,
        *pointda10.FORMATS,
        modelnet_meshes.FORMAT,
        modelnet_h5.FORMAT,
        scanobjectnn.FORMAT,
        *xyz_trees.FORMATS,
        *graspnet.FORMATS,
        *point_folders.FORMATS,
        archive.FORMAT,
    )
}
"""Every layout by its name; the imports that weigh happen where a layout is read or written."""
