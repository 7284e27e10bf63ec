"""QBST over its threshold θ₀ and step ε.

Paper: QS³ (ECCV 2022), supplement, Fig. 2: accuracy over θ₀ and over ε, sources M and S, target D.
The figure has no printed numbers: best at θ₀ = 0.8 and ε = 0.005, and S above M throughout. The
grid of values here is ours.
"""

from qs3.paper.cells import PAPER
from qs3.paper.experiment import Experiment, Heading
from qs3.paper.scales import Scale


def experiment(scale: Scale) -> Experiment:
    """Return both sources as rows, thresholds and steps as columns."""
    axes = (("threshold", "theta", "θ₀", scale.thetas), ("step", "step", "ε", scale.steps))
    return Experiment(
        title="Threshold θ₀ and step ε of QBST",
        source="QS³, ECCV 2022, supplement, Fig. 2: a figure without printed numbers; best at 0.8 "
        "and 0.005",
        rows=tuple(Heading(kind, f"QBST, {kind} → D", {"source": kind}) for kind in "MS"),
        columns=tuple(
            Heading(f"qbst-{word}-{value:g}", f"{axis} = {value:g}", {name: value}, axis, value)
            for name, word, axis, values in axes
            for value in values
        ),
        fields={"row": PAPER, "target": "D"},
        pairs=[("S over M", "S", "M")],
        notes=("The columns of ε have the scale's θ₀, those of θ₀ the preset's ε (0.005).",),
        corner="source",
    )
