"""Experiments that can be rerun: one file a table, its records, and the paper's figures beside."""
