"""The paper: its networks, rival methods and data, and its tables, which can be rerun."""

from importlib.resources import files
from typing import Literal

GALLERIES = "galleries"
"""Pictures of the domains, made of scans alone."""
TABLES = tuple(
    sorted(
        file.name.removesuffix(".py").replace("_", "-")
        for file in files("qs3.paper.tables").iterdir()
        if file.name.endswith(".py") and file.name != "__init__.py"
    )
)
"""Names of all tables: the files of `qs3.paper.tables`."""
ScaleName = Literal["smoke", "laptop", "full", "small", "paper"]
"""Sizes; see `qs3.paper.scales.SCALES`."""
TableFormat = Literal["md", "csv", "tex"]
"""Forms of a table."""
FigureFormat = Literal["png", "svg"]
"""Forms of a figure."""
