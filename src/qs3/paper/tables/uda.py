"""Methods of adaptation, as the paper compares them.

Paper: QS³ (ECCV 2022), main table of adaptation and supplement, Table 2: M→D, S→D, S→S*, DGCNN.
Published: QBST 66.4 on M→D; QS³ 72.4 on S→D and 57.4 on S→S*, 8.4 and 6.3 over no adaptation.

QBST has the settings of the paper's text (preset ``paper``), ours, and those that lost least on
real objects. The columns of R and U are not in the paper, nor are rows that train without rounds
for as many steps as others do with them (`qs3.paper.scales.Scale.more_steps`).
"""

from qs3.paper.cells import ORDINARY, PAPER, SUPERVISED
from qs3.paper.experiment import Experiment, Heading, tasks
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
_WITHOUT_ROUNDS = (ORDINARY, "pointdan", "defrec", "defrec-pcm", "gast")
_USUAL = ("M-D", "S-D", "S-F", "S-R", "S-U")


def experiment(scale: Scale) -> Experiment:
    """Return methods as rows: of the bench's network, of DGCNN, and PointDAN's own."""
    networks = {"": [*_TITLES]}
    if scale.train.model != "dgcnn":
        networks["dgcnn"] = [row for row in _TITLES if row != "pointdan"]
    networks["pointnet-sa"] = [ORDINARY, "pointdan"]
    numbers = (None, *scale.more_steps)
    rows, pairs = [], []
    for network, methods in networks.items():
        after, of = (f"@{network}", f", {_NETWORKS[network]}") if network else ("", "")
        for steps in numbers:
            words = f", {steps:,} steps" if steps else ""
            for row in methods:
                if not steps or row in _WITHOUT_ROUNDS:
                    fields = {"row": row, "network": network, "steps": steps}
                    title = f"{_TITLES[row]}{words}{of}"
                    rows.append(Heading(f"{_key(row, steps)}{after}", title, fields))
            for what, first, second in _compared(steps):
                if {first, second} <= {*methods}:
                    keys = (f"{_key(row, steps)}{after}" for row in (first, second))
                    pairs.append((f"{what}{words}{of}", *keys))
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


def _key(row: str, steps: int | None) -> str:
    return f"{row}-{steps}" if steps and row in _WITHOUT_ROUNDS else row


def _compared(steps: int | None) -> list[tuple[str, str, str]]:
    """Return title and rows of each difference; rounds count their own steps."""
    rivals = _WITHOUT_ROUNDS[1:] if steps else _RIVALS
    pairs = [(f"{_TITLES[row]} over no adaptation", row, ORDINARY) for row in [*_TITLES][2:]]
    return pairs + [(f"QBST over {_TITLES[row]}", PAPER, row) for row in rivals]
