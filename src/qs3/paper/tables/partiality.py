"""Missing surface against noise.

Not in the paper. Samples of the whole surface; noise-free one-sided twins; noisy one-sided scans
(the released code's five poses of one side); noisy scans from all around.
"""

from qs3.paper.cells import ORDINARY
from qs3.paper.experiment import Experiment, Heading, networks
from qs3.paper.scales import Scale

_SOURCES = {
    "M": "whole surface",
    "C": "one side, clean",
    "J": "one side, noisy",
    "S": "all around, noisy",
}


def experiment(scale: Scale) -> Experiment:
    """Return networks as rows, sources as columns."""
    titles = _SOURCES if scale.source_views > 1 else _SOURCES | {"S": "one view, noisy"}
    return Experiment(
        title="Partiality control: scored on D",
        source="not in the paper",
        rows=networks(scale),
        columns=tuple(Heading(kind, title, {"source": kind}) for kind, title in titles.items()),
        fields={"row": ORDINARY, "target": "D"},
        pairs=[
            ("missing surface", "C", "M"),
            ("noise, one side", "J", "C"),
            ("both", "J", "M"),
            ("orbit", "S", "J"),
        ],
        fixed=("M", "S", "C", "J"),
    )
