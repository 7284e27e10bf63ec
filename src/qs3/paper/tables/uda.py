"""Methods of adaptation, as the paper compares them.

Paper: QS³ (ECCV 2022), main table of adaptation and supplement, Table 2: M→D, S→D, S→S*, DGCNN.
Published: QBST 66.4 on M→D; QS³ 72.4 on S→D and 57.4 on S→S*, 8.4 and 6.3 over no adaptation.

QBST has the settings of the paper's text (preset ``paper``), ours, and those that lost least on
real objects. The columns of R and U are not in the paper.
"""

from qs3.paper.cells import ORDINARY, PAPER, SUPERVISED
from qs3.paper.experiment import Experiment, Heading, lines, tasks
from qs3.paper.scales import Scale

_TITLES = {
    SUPERVISED: "Supervised",
    ORDINARY: "without adaptation",
    "pointdan": "PointDAN",
    "defrec": "DefRec",
    "defrec-pcm": "DefRec + PCM",
    "gast": "GAST without SPST",
    "gast-spst": "GAST",
    "spst": "SPST",
    PAPER: "QBST (on S: QS³)",
    "qbst": "QBST, our settings",
    "qbst-gentle": "QBST, gentle rounds",
}
_NETWORKS = {"dgcnn": "DGCNN", "pointnet-sa": "PointNet-SA"}
_RIVALS = ("gast-spst", "defrec-pcm", "spst")
_USUAL = ("M-D", "S-D", "S-F", "S-R", "S-U")


def experiment(scale: Scale) -> Experiment:
    """Return methods as rows: of the bench's network, of DGCNN, and PointDAN's own."""
    rows = list(lines(_TITLES))
    compared = [(f"{_TITLES[row]} over no adaptation", row, ORDINARY) for row in [*_TITLES][2:]]
    compared += [(f"QBST over {_TITLES[row]}", PAPER, row) for row in _RIVALS]
    networks = {"dgcnn": [row for row in _TITLES if row != "pointdan"]}
    if scale.train.model == "dgcnn":
        networks = {}
    networks["pointnet-sa"] = [ORDINARY, "pointdan"]
    pairs = list(compared)
    for network, methods in networks.items():
        for row in methods:
            fields = {"row": row, "network": network}
            title = f"{_TITLES[row]}, {_NETWORKS[network]}"
            rows.append(Heading(f"{row}@{network}", title, fields))
        pairs += [
            (f"{what}, {_NETWORKS[network]}", f"{first}@{network}", f"{second}@{network}")
            for what, first, second in compared
            if {first, second} <= {*methods}
        ]
    return Experiment(
        title="Unsupervised adaptation",
        rows=tuple(rows),
        columns=tasks(
            *(("M", "D"), ("S", "D"), ("S", "F"), ("S", "R"), ("S", "U"), ("M", "R"), ("M", "U"))
        ),
        published="methods",
        pairs=pairs,
        usual=_USUAL,
        notes=("DefRec and PCM work in the unit ball: their networks get no sizes.",),
        corner="method",
    )
