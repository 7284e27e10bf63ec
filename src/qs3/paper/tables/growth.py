"""Does self-training gain more if the target has more clouds?

Not in the paper, whose target has 6,110 clouds: its rounds keep a few of the most confident ones,
which on a small target are too few to train on.
"""

from qs3.paper.cells import ORDINARY, PAPER
from qs3.paper.experiment import Experiment, Heading
from qs3.paper.scales import Scale

_SIZES = (500, 1500)
_TITLES = {
    ORDINARY: "without adaptation",
    PAPER: "QBST, paper",
    "qbst-released": "QBST, released code",
    "qbst-gentle": "QBST, gentle rounds",
    "spst": "SPST",
}


def experiment(scale: Scale) -> Experiment:
    """Return rows of sources, methods and two networks; columns of sizes."""
    rows, pairs = [], []
    for network in ("",) if scale.train.model == "dgcnn" else ("", "dgcnn"):
        for source in ("S", "M"):
            after, words = (f"@{network}", f", {network.upper()}") if network else ("", "")
            for row, title in _TITLES.items():
                key, plain = (f"{source}:{each}{after}" for each in (row, ORDINARY))
                fields = {"source": source, "row": row, "network": network}
                rows.append(Heading(key, f"{source}, {title}{words}", fields))
                pairs += [(f"{key} over {plain}", key, plain)] if key != plain else []
    whole = scale.count_clouds("D")
    sizes = {str(size): size for size in _SIZES if size < whole}
    return Experiment(
        title="Gain over the size of the target, D",
        source="not in the paper",
        rows=tuple(rows),
        columns=tuple(
            Heading(
                key,
                f"{key} clouds",
                {"target": "D", "target_clouds": sizes.get(key)},
                "clouds to adapt to",
                float(sizes.get(key, whole)),
            )
            for key in (*sizes, "all")
        ),
        pairs=pairs,
        corner="source, method",
        fixed=("D",),
    )
