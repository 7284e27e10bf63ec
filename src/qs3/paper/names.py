"""Names of the paper's networks and rival methods, which `qs3.lazy.load_names` makes known.

The rooms below know no class of this one: they take classes, and names that were added to theirs.
"""

from typing import Literal

from qs3.adaptation.names import COMPOSED, METHODS
from qs3.models.factory import MODELS

MethodName = Literal[
    "source-only",
    "pointdan",
    "defrec",
    "pcm",
    "defrec-pcm",
    "gast",
    "spst",
    "qbst",
    "gast-spst",
]
"""Methods of adaptation; the last three end in rounds of self-training."""

WITHOUT_TARGET = ("source-only", "pcm")
"""Methods whose training does without the target; rounds of self-training never do."""

MODELS |= {
    "pointnet-sa": "qs3.paper.networks.pointnet_sa:PointNetSA",
    "rscnn": "qs3.paper.networks.rscnn:RSCNN",
    "simpleview": "qs3.paper.networks.simpleview:SimpleView",
}
METHODS |= {
    "pointdan": "qs3.paper.rivals.pointdan:PointDAN",
    "defrec": "qs3.paper.rivals.defrec:DefRec",
    "pcm": "qs3.paper.rivals.pcm:PCM",
    "defrec-pcm": "qs3.paper.rivals.pcm:DefRecPCM",
    "gast": "qs3.paper.rivals.gast:GAST",
}
COMPOSED |= {"gast-spst": ("gast", "spst")}
