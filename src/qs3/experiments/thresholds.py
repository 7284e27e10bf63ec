"""Which threshold and which step of it serve QBST best?

Paper: QS³ (ECCV 2022), supplement, Fig. 2: accuracy over θ₀ and over ε, sources M and S, target D.
The figure has no printed numbers: best at θ₀ = 0.8 and ε = 0.005, and S above M throughout. The
grid of values here is ours.
Command: ``qs3 reproduce thresholds --out DIR`` (``--dry-run`` prints the hours on this machine).
"""

from qs3.experiments.experiment import Experiment, Named, Place
from qs3.experiments.rows import PAPER, STEP, THETA
from qs3.experiments.runs import Run, make_run
from qs3.experiments.scales import Scale

_SOURCES = (("M", "QBST, M → D"), ("S", "QBST, S → D"))


def _columns(scale: Scale) -> Named:
    return (
        *((f"{THETA}{value:g}", f"θ₀ = {value:g}") for value in scale.thetas),
        *((f"{STEP}{value:g}", f"ε = {value:g}") for value in scale.steps),
    )


def _run(scale: Scale, row: str, column: str, seed: int, threads: int | None) -> Run:
    run = make_run(scale, f"{row}-D", column, seed, threads)
    whole = make_run(scale, f"{row}-D", PAPER, seed, threads)
    # The preset's own values are one training with the table of methods.
    return whole if run.self_training == whole.self_training else run


def _pairs(scale: Scale) -> list[tuple[str, Place, Place]]:
    return [(f"S over M, {title}", ("S", key), ("M", key)) for key, title in _columns(scale)]


EXPERIMENT = Experiment(
    name="thresholds",
    title="Threshold θ₀ and step ε of QBST",
    source="QS³, ECCV 2022, supplement, Fig. 2: a figure without printed numbers; best at 0.8 "
    "and 0.005",
    rows=lambda scale: _SOURCES,
    columns=_columns,
    run=_run,
    pairs=_pairs,
    notes=("The columns of ε have the scale's θ₀, those of θ₀ the preset's ε (0.005).",),
    corner="source",
    lines=((THETA, "θ₀"), (STEP, "ε")),
)
"""The supplement's Fig. 2."""
