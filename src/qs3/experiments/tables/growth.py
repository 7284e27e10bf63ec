"""Does self-training gain more if the target has more clouds?

Not in the paper, whose target has 6,110 clouds: its rounds keep a few of the most confident ones,
which on a small target are too few to train on.
"""

from qs3.experiments.domains import Domain
from qs3.experiments.experiment import Experiment, Heading, Headings, Pair
from qs3.experiments.runs import ORDINARY, PAPER
from qs3.experiments.scales import Scale
from qs3.meshes.classes import POINTDA10

_SIZES = (500, 1500, 3000)

_TITLES = {
    ORDINARY: "without adaptation",
    PAPER: "QBST, paper",
    "qbst-released": "QBST, released code",
    "qbst-gentle": "QBST, gentle rounds",
    "spst": "SPST",
}


def _networks(scale: Scale) -> tuple[str, ...]:
    return ("",) if scale.train.model == "dgcnn" else ("", "dgcnn")


def _key(source: str, row: str, network: str) -> str:
    return f"{source}:{row}@{network}" if network else f"{source}:{row}"


def _rows(scale: Scale) -> Headings:
    return tuple(
        Heading(
            _key(source, row, network),
            f"{source}, {title}{f', {network.upper()}' if network else ''}",
            {"source": Domain(source), "row": row, "network": network},
        )
        for network in _networks(scale)
        for source in ("S", "M")
        for row, title in _TITLES.items()
    )


def _pairs(scale: Scale) -> list[Pair]:
    pairs = []
    for network in _networks(scale):
        for source in ("S", "M"):
            plain, *rounds = (_key(source, row, network) for row in _TITLES)
            pairs += [(f"{key} over {plain}", key, plain) for key in rounds]
    return pairs


def _columns(scale: Scale) -> Headings:
    whole = sum(scale.target_count(name, scale.target_per_class) for name in POINTDA10)
    sizes = {str(size): size for size in _SIZES if size < whole} | {"all": 0}
    return tuple(
        Heading(
            key,
            f"{key} clouds",
            {"target": Domain("D", clouds=size)},
            "clouds to adapt to",
            float(size or whole),
        )
        for key, size in sizes.items()
    )


EXPERIMENT = Experiment(
    title="Gain over the size of the target, D",
    source="not in the paper",
    rows=_rows,
    columns=_columns,
    pairs=_pairs,
    corner="source, method",
    made=("D",),
)
"""The question that the paper leaves open."""
