"""Names of the lines of tables."""

from collections.abc import Mapping
from typing import Any

SUPERVISED = "supervised"
"""Row of the network that is trained on the labelled training part of the target."""
ORDINARY = "ordinary"
"""Row of a network that is trained on the source and sees no cloud of the target: one training
serves all test sets."""
PAPER = "qbst-paper"
"""Row of QBST as the paper's text has it (preset ``paper``)."""
THETA, STEP = "qbst-theta-", "qbst-step-"
"""Rows of QBST as the paper's text has it, at another θ₀ or ε: the number follows."""
NETWORKS = ("pointnet2", "dgcnn", "rscnn", "simpleview")
"""The paper's networks, in the order of its table."""
TABLE_ROWS: tuple[str, ...] = (
    SUPERVISED,
    "source-only",
    "pointdan",
    "defrec",
    "defrec-pcm",
    "gast",
    "gast-spst",
    "qbst",
)
"""The paper's rows; on scans ``qbst`` is QS³."""
FURTHER_ROWS: tuple[str, ...] = ("dann", "mmd", "coral", "sd", "spst")
"""Methods that the paper's table lacks."""
ROWS = (*TABLE_ROWS, *FURTHER_ROWS)
"""Rows of the bench, in the order of the table."""

ABLATIONS: Mapping[str, Mapping[str, Any]] = {
    "qbst": {},
    "qbst-least-confident": {"selection": "least-confident"},
    "qbst-scratch": {"init": "scratch"},
    "qbst-best-labeller": {"labeller": "best"},
    "qbst-no-source-loss": {"source_loss": False},
}
"""Rows of the ablation: what each changes in the settings of self-training."""
