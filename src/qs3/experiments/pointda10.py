"""The six tasks of PointDA-10.

Source of the tasks: PointDAN (NeurIPS 2019); the published cells are those of the aligned protocol
of DefRec (WACV 2021) with DGCNN, as later papers cite them. QS³ has no such table.
Command: ``qs3 reproduce pointda10 --out DIR --data M=modelnet N=shapenet F=scannet`` with the
folders of PointDA_data; without ``--data`` stand-ins are made (``--dry-run`` prints the hours).
"""

from qs3.experiments.cells import published_cells, published_source, tasks
from qs3.experiments.experiment import Experiment, Named, Place
from qs3.experiments.rows import ORDINARY, PAPER
from qs3.experiments.runs import Run, make_run
from qs3.experiments.scales import Scale

_TITLES = {
    ORDINARY: "without adaptation",
    "dann": "DANN",
    "pointdan": "PointDAN",
    "defrec": "DefRec",
    "defrec-pcm": "DefRec + PCM",
    "gast": "GAST without SPST",
    "gast-spst": "GAST",
    PAPER: "QBST",
}
_TASKS = ("M-N", "M-F", "N-M", "N-F", "F-M", "F-N")


def _rows(scale: Scale) -> Named:
    return tuple((key, title) for key, title in _TITLES.items() if key in scale.pointda10)


def _run(scale: Scale, row: str, column: str, seed: int, threads: int | None) -> Run:
    return make_run(scale, column, row, seed, threads)


def _pairs(scale: Scale) -> list[tuple[str, Place, Place]]:
    return [
        (f"{title} over no adaptation, {heading}", (key, task), (ORDINARY, task))
        for task, heading in tasks(*_TASKS)
        for key, title in _rows(scale)
        if key != ORDINARY
    ]


EXPERIMENT = Experiment(
    name="pointda10",
    title="The six tasks of PointDA-10",
    source=published_source("pointda10"),
    rows=_rows,
    columns=lambda scale: tasks(*_TASKS),
    run=_run,
    published=published_cells("pointda10"),
    pairs=_pairs,
    corner="method",
    notes=("N stands for ShapeNet10 here, which PointDA-10 calls S.",),
)
"""A table of the field."""
