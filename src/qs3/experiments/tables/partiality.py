"""Missing surface against noise.

Not in the paper. Samples of the whole surface; noise-free one-sided twins; noisy one-sided scans
(the released code's five poses of one side); noisy scans from all around.
"""

from qs3.experiments.domains import Domain
from qs3.experiments.experiment import Experiment, Heading, networks
from qs3.experiments.runs import ORDINARY

_COLUMNS = (
    Heading("M", "whole surface", {"source": Domain("M")}),
    Heading("C", "one side, clean", {"source": Domain("C")}),
    Heading("J", "one side, noisy", {"source": Domain("J")}),
    Heading("S", "all around, noisy", {"source": Domain("S")}),
)
_PAIRS = (
    ("missing surface", "C", "M"),
    ("noise, one side", "J", "C"),
    ("both", "J", "M"),
    ("orbit", "S", "J"),
)

EXPERIMENT = Experiment(
    title="Partiality control: scored on D",
    source="not in the paper",
    rows=networks,
    columns=lambda scale: _COLUMNS,
    fields={"row": ORDINARY, "target": Domain("D")},
    pairs=lambda scale: _PAIRS,
    made=("M", "S", "C", "J"),
)
