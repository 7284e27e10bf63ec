"""Readers and writers of the data sets of this field, one file a layout."""

from qs3.io.layouts import (
    archive,
    graspnet,
    modelnet_h5,
    modelnet_meshes,
    point_folders,
    pointda10,
    scanobjectnn,
    store,
    xyz_trees,
)
from qs3.io.layouts.format import Format as Format

FORMATS: dict[str, Format] = {
    layout.name: layout
    for layout in (
        store.FORMAT,
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
