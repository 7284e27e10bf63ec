"""Methods of adaptation, as the paper compares them.

Paper: QS³ (ECCV 2022), main table of adaptation and supplement, Table 2: M→D, S→D, S→S*, DGCNN.
Published: QBST 66.4 on M→D; QS³ 72.4 on S→D and 57.4 on S→S*, 8.4 and 6.3 over no adaptation.

QBST has the settings of the paper's text (preset ``paper``), ours, and those that lost least on
real objects. DANN and the columns of R and U are not in the paper.
"""

from qs3.experiments.experiment import Experiment, Heading, Headings, lines, tasks
from qs3.experiments.runs import ORDINARY, PAPER, SUPERVISED
from qs3.experiments.scales import Scale

_TITLES = {
    SUPERVISED: "Supervised",
    ORDINARY: "without adaptation",
    "pointdan": "PointDAN",
    "defrec": "DefRec",
    "defrec-pcm": "DefRec + PCM",
    "gast": "GAST without SPST",
    "gast-spst": "GAST",
    "spst": "SPST",
    "dann": "DANN",
    PAPER: "QBST (on S: QS³)",
    "qbst": "QBST, our settings",
    "qbst-gentle": "QBST, gentle rounds",
}
_DGCNN = {
    f"{row}@dgcnn": Heading(f"{row}@dgcnn", f"{title}, DGCNN", {"row": row, "network": "dgcnn"})
    for row, title in _TITLES.items()
    if row != "pointdan"
}
"""Rows of the paper's network, if the bench's is another. PointDAN has its own network."""
_POINTDAN = Heading(
    "pointdan@pointnet-sa",
    "PointDAN, its own network",
    {"row": "pointdan", "network": "pointnet-sa"},
)
_USUAL = ("M-D", "S-D", "S-F", "S-R", "S-U")
_TASKS = tasks(("M", "D"), ("S", "D"), ("S", "F"), ("S", "R"), ("S", "U"), ("M", "R"), ("M", "U"))
_PAIRS = (
    *((f"{_TITLES[row]} over no adaptation", row, ORDINARY) for row in list(_TITLES)[2:]),
    *((f"QBST over {_TITLES[row]}", PAPER, row) for row in ("gast-spst", "defrec-pcm", "spst")),
    *(
        (f"{_TITLES[row]} over no adaptation, DGCNN", f"{row}@dgcnn", f"{ORDINARY}@dgcnn")
        for row in list(_TITLES)[2:]
        if row != "pointdan"
    ),
    *(
        (f"QBST over {_TITLES[row]}, DGCNN", f"{PAPER}@dgcnn", f"{row}@dgcnn")
        for row in ("gast-spst", "defrec-pcm", "spst")
    ),
)


def _rows(scale: Scale) -> Headings:
    more = () if scale.train.model == "dgcnn" else tuple(_DGCNN.values())
    return (*lines(_TITLES), *more, _POINTDAN)


EXPERIMENT = Experiment(
    title="Unsupervised adaptation",
    rows=_rows,
    columns=lambda scale: _TASKS,
    published="methods",
    # Beside the paper's settings alone.
    published_as={
        ORDINARY: "source-only",
        PAPER: "qbst",
        "qbst": "",
        _POINTDAN.key: "pointdan",
        **{key: key.removesuffix("@dgcnn") for key in _DGCNN},
        f"{ORDINARY}@dgcnn": "source-only",
        f"{PAPER}@dgcnn": "qbst",
        "qbst@dgcnn": "",
    },
    pairs=lambda scale: _PAIRS,
    usual=lambda scale: _USUAL,
    notes=("DefRec and PCM work in the unit ball: their networks are told no sizes.",),
    corner="method",
)
