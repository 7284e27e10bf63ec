"""Readers and writers of the data sets of this field, one file a layout."""
