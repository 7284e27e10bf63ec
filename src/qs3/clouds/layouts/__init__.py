"""Readers and writers of data set layouts, one file per layout."""

from qs3.clouds.layouts import folders, npz, store
from qs3.clouds.layouts.folders import Format as Format
from qs3.lazy import load_names

FORMATS: dict[str, Format] = {
    layout.name: layout for layout in (store.FORMAT, npz.FORMAT, *folders.FORMATS)
}
"""Layouts by name, to which a package adds those that it brings: `formats` returns all."""


def formats() -> dict[str, Format]:
    """Return all layouts by name; heavy libraries are imported only when one is read or written."""
    load_names()
    return FORMATS
