"""Names of all tables and figures, for the command line: nothing is imported for them."""

from typing import Literal

TableName = Literal[
    "ordinary",
    "uda",
    "real2sim",
    "views",
    "thresholds",
    "partiality",
    "sensors",
    "pointda10",
]
"""Tables that are read from records, each with its figure."""
PartName = Literal[TableName, "galleries", "adaptation-bench", "adaptation-ablation"]
"""Everything that can be reproduced."""
ScaleName = Literal["smoke", "laptop", "small", "paper"]
"""Sizes; see `qs3.experiments.scales.SCALES`."""
TableFormat = Literal["md", "csv", "tex"]
"""Forms of a table."""
FigureFormat = Literal["png", "svg"]
"""Forms of a figure."""
