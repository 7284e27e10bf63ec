"""Readers and writers of data set layouts, one file per layout."""

from qs3.clouds.layouts import folders, hdf5, modelnet_normal, npz, pointda10, store
from qs3.clouds.layouts.folders import Format as Format

FORMATS: dict[str, Format] = {
    layout.name: layout
    for layout in (
        store.FORMAT,
        npz.FORMAT,
        hdf5.FORMAT,
        *folders.FORMATS,
        modelnet_normal.FORMAT,
        pointda10.FORMAT,
    )
}
"""All layouts by name; heavy libraries are imported only when a layout is read or written."""
