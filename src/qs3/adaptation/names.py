"""Names of methods, rules and options, for those who must not wait for PyTorch to load."""

from collections.abc import Mapping
from typing import Literal

from qs3.errors import InputError

MethodName = Literal[
    "source-only",
    "pointdan",
    "defrec",
    "pcm",
    "defrec-pcm",
    "gast",
    "spst",
    "qbst",
    "gast-spst",
]
"""Methods of adaptation; the last three end in rounds of self-training (`COMPOSED`)."""

RoundRule = Literal["qbst", "spst"]
"""Selection rules of self-training."""

Selection = Literal["most-confident", "least-confident"]
"""End of a class's ranking by confidence that is kept."""

SingleClass = Literal["keep", "drop"]
"""Action if all confident clouds have one class (μ = 0)."""

Rule = Literal["last", "source-val"]
"""Rules that choose a run's network: the last checkpoint, or the most accurate on held-out
source."""

METHODS: Mapping[str, str] = {
    "source-only": "qs3.adaptation.source_only:SourceOnly",
    "pointdan": "qs3.paper.rivals.pointdan:PointDAN",
    "defrec": "qs3.paper.rivals.defrec:DefRec",
    "pcm": "qs3.paper.rivals.pcm:PCM",
    "defrec-pcm": "qs3.paper.rivals.pcm:DefRecPCM",
    "gast": "qs3.paper.rivals.gast:GAST",
}
"""Module and class of each method without rounds."""

COMPOSED: Mapping[str, tuple[str, RoundRule]] = {
    "spst": ("source-only", "spst"),
    "qbst": ("source-only", "qbst"),
    "gast-spst": ("gast", "spst"),
}
"""Methods that are a warm-up and a rule of self-training."""

WITHOUT_TARGET = ("source-only", "pcm")
"""Methods whose training does without the target; rounds of self-training never do."""


def split_method(method: str, rounds: str | None = None) -> tuple[str, str | None]:
    """Return the warm-up and the selection rule of a method; ``rounds`` is a requested rule.

    Example:
        >>> split_method("qbst"), split_method("gast", "qbst"), split_method("pcm")
        (('source-only', 'qbst'), ('gast', 'qbst'), ('pcm', None))
    """
    if method not in COMPOSED:
        return method, rounds
    warm_up, own = COMPOSED[method]
    if rounds is not None and rounds != own:
        raise InputError(
            f"method {method} is {warm_up} with {own}; for another rule choose method {warm_up} "
            f"with self-training {rounds}"
        )
    return warm_up, own
