"""Accuracy over the number of fused views.

Paper: QS³ (ECCV 2022), supplement, Fig. 1: accuracy of S→D over the number of fused views, four
networks. The figure has no printed numbers: more views are better, and the paper takes five.
"""

from qs3.experiments.domains import Domain
from qs3.experiments.experiment import Experiment, Heading, Headings, Pair, networks
from qs3.experiments.runs import ORDINARY
from qs3.experiments.scales import Scale


def _columns(scale: Scale) -> Headings:
    sources = {
        count: Domain("S") if count == scale.source_views else Domain("V", views=count)
        for count in scale.fused_views
    }
    return tuple(
        Heading(str(count), str(count), {"source": source}, "fused views", float(count))
        for count, source in sources.items()
    )


def _pairs(scale: Scale) -> list[Pair]:
    first, *more = map(str, scale.fused_views)
    return [(f"{count} views over {first}", count, first) for count in more]


EXPERIMENT = Experiment(
    title="Number of fused views, S → D",
    source="QS³, ECCV 2022, supplement, Fig. 1: a figure without printed numbers; it rises with "
    "the number of views",
    rows=networks,
    columns=_columns,
    fields={"row": ORDINARY, "target": Domain("D")},
    pairs=_pairs,
    made=("S",),
)
