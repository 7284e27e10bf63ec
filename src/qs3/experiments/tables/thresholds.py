"""QBST over its threshold θ₀ and step ε.

Paper: QS³ (ECCV 2022), supplement, Fig. 2: accuracy over θ₀ and over ε, sources M and S, target D.
The figure has no printed numbers: best at θ₀ = 0.8 and ε = 0.005, and S above M throughout. The
grid of values here is ours.
"""

from qs3.experiments.domains import Domain
from qs3.experiments.experiment import Experiment, Heading, Headings
from qs3.experiments.runs import PAPER
from qs3.experiments.scales import Scale


def _columns(scale: Scale) -> Headings:
    return tuple(
        Heading(f"qbst-{word}-{value:g}", f"{axis} = {value:g}", {name: value}, axis, value)
        for name, word, axis, values in (
            ("threshold", "theta", "θ₀", scale.thetas),
            ("step", "step", "ε", scale.steps),
        )
        for value in values
    )


EXPERIMENT = Experiment(
    title="Threshold θ₀ and step ε of QBST",
    source="QS³, ECCV 2022, supplement, Fig. 2: a figure without printed numbers; best at 0.8 "
    "and 0.005",
    rows=lambda scale: tuple(
        Heading(kind, f"QBST, {kind} → D", {"source": Domain(kind)}) for kind in ("M", "S")
    ),
    columns=_columns,
    fields={"row": PAPER, "target": Domain("D")},
    pairs=lambda scale: [("S over M", "S", "M")],
    notes=("The columns of ε have the scale's θ₀, those of θ₀ the preset's ε (0.005).",),
    corner="source",
)
