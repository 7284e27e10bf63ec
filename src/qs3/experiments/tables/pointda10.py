"""The six tasks of PointDA-10.

Source of the tasks: PointDAN (NeurIPS 2019); the published cells are those of the aligned protocol
of DefRec (WACV 2021) with DGCNN, as later papers cite them. QS³ has no such table.
Command: ``qs3 reproduce pointda10 --out DIR --data M=modelnet N=shapenet F=scannet`` with the
folders of PointDA_data; without ``--data`` stand-ins are made.
"""

from qs3.experiments.experiment import Experiment, Headings, Pair, lines, tasks
from qs3.experiments.runs import ORDINARY, PAPER
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
_TASKS = tasks(("M", "N"), ("M", "F"), ("N", "M"), ("N", "F"), ("F", "M"), ("F", "N"))


def _rows(scale: Scale) -> Headings:
    return lines({row: title for row, title in _TITLES.items() if row in scale.pointda10})


def _pairs(scale: Scale) -> list[Pair]:
    return [
        (f"{row.title} over no adaptation", row.key, ORDINARY)
        for row in _rows(scale)
        if row.key != ORDINARY
    ]


EXPERIMENT = Experiment(
    title="The six tasks of PointDA-10",
    rows=_rows,
    columns=lambda scale: _TASKS,
    published="pointda10",
    pairs=_pairs,
    corner="method",
    notes=("N stands for ShapeNet10 here, which PointDA-10 calls S.",),
)
