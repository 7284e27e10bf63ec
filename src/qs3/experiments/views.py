"""How many fused views make the best source?

Paper: QS³ (ECCV 2022), supplement, Fig. 1: accuracy of S→D over the number of fused views, four
networks. The figure has no printed numbers: more views are better, and the paper takes five.
Command: ``qs3 reproduce views --out DIR`` (``--dry-run`` prints the hours on this machine).
"""

from qs3.experiments.cells import networks
from qs3.experiments.domains import VIEWS
from qs3.experiments.experiment import Experiment, Named, Place
from qs3.experiments.rows import ORDINARY
from qs3.experiments.runs import Run, make_run
from qs3.experiments.scales import Scale


def _columns(scale: Scale) -> Named:
    return tuple((str(count), str(count)) for count in scale.fused_views)


def _run(scale: Scale, row: str, column: str, seed: int, threads: int | None) -> Run:
    source = "S" if int(column) == scale.source_views else f"{VIEWS}{column}"
    return make_run(scale, f"{source}-D", ORDINARY, seed, threads, network=row)


def _pairs(scale: Scale) -> list[tuple[str, Place, Place]]:
    first, last = str(scale.fused_views[0]), str(scale.fused_views[-1])
    return [
        (f"{last} views over {first}, {title}", (row, last), (row, first))
        for row, title in networks(scale)
    ]


EXPERIMENT = Experiment(
    name="views",
    title="Number of fused views, S → D",
    source="QS³, ECCV 2022, supplement, Fig. 1: a figure without printed numbers; it rises with "
    "the number of views",
    rows=networks,
    columns=_columns,
    run=_run,
    pairs=_pairs,
    made=("S",),
    lines=(("", "fused views"),),
)
"""The supplement's Fig. 1."""
