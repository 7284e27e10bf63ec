"""Accuracy over the number of fused views.

Paper: QS³ (ECCV 2022), supplement, Fig. 1: accuracy of S→D over the number of fused views, four
networks. The figure has no printed numbers: more views are better, and the paper takes five.
"""

from qs3.paper.cells import ORDINARY
from qs3.paper.experiment import Experiment, Heading, networks
from qs3.paper.scales import Scale


def experiment(scale: Scale) -> Experiment:
    """Return networks as rows, numbers of views as columns."""
    sources = {
        n: {"source": "S"} if n == scale.source_views else {"source": "V", "source_views": n}
        for n in scale.fused_views
    }
    first, *more = scale.fused_views
    return Experiment(
        title="Number of fused views, S → D",
        source="QS³, ECCV 2022, supplement, Fig. 1: a figure without printed numbers; it rises "
        "with the number of views",
        rows=networks(scale),
        columns=tuple(
            Heading(str(n), str(n), source, "fused views", float(n))
            for n, source in sources.items()
        ),
        fields={"row": ORDINARY, "target": "D"},
        pairs=[(f"{n} views over {first}", str(n), str(first)) for n in more],
        fixed=("S",),
    )
