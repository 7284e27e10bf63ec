"""How much of the gain is noise, and how much is missing surface?

Not in the paper, which compares whole surfaces with noisy one-sided scans and cannot tell them
apart. Here: samples of the whole surface; the noise-free one-sided twins; the noisy one-sided scans
(the released code's five poses of one side); noisy scans from all around.
Command: ``qs3 reproduce partiality --out DIR`` (``--dry-run`` prints the hours on this machine).
"""

from qs3.experiments.cells import networks
from qs3.experiments.experiment import Experiment, Named, Place
from qs3.experiments.rows import ORDINARY
from qs3.experiments.runs import Run, make_run
from qs3.experiments.scales import Scale

_COLUMNS: Named = (
    ("M", "whole surface"),
    ("C", "one side, clean"),
    ("J", "one side, noisy"),
    ("S", "all around, noisy"),
)


def _run(scale: Scale, row: str, column: str, seed: int, threads: int | None) -> Run:
    return make_run(scale, f"{column}-D", ORDINARY, seed, threads, network=row)


def _pairs(scale: Scale) -> list[tuple[str, Place, Place]]:
    steps = (("missing surface", "C", "M"), ("noise, one side", "J", "C"), ("orbit", "S", "J"))
    return [
        (f"{what}, {title}", (row, after), (row, before))
        for row, title in networks(scale)
        for what, after, before in steps
    ]


EXPERIMENT = Experiment(
    name="partiality",
    title="Partiality control: scored on D",
    source="not in the paper",
    rows=networks,
    columns=lambda scale: _COLUMNS,
    run=_run,
    pairs=_pairs,
    made=("M", "S", "C", "J"),
)
"""A control that the paper lacks."""
