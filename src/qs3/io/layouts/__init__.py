"""Readers and writers of the data sets of this field, one file a data set or a kin of them."""

from qs3.io.layouts import modelnet, npz, point_folders, pointda10, scanobjectnn, store, trees
from qs3.io.layouts.format import Format as Format

FORMATS: dict[str, Format] = {
    layout.name: layout
    for layout in (
        store.FORMAT,
        *pointda10.FORMATS,
        *modelnet.FORMATS,
        scanobjectnn.FORMAT,
        *trees.FORMATS,
        *point_folders.FORMATS,
        npz.FORMAT,
    )
}
"""Every layout by its name; the imports that weigh happen where a layout is read or written."""

FORMER_NAMES = {"qs3": "store"}
"""Names that a layout had before, still taken."""
