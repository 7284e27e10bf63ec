"""Names of methods, rules and options, for those who must not wait for PyTorch to load."""

from typing import Literal

from qs3.errors import InputError
from qs3.lazy import load_names

UNKNOWN = "unknown"
"""What a rejected cloud is called in answers, in the place of a class."""

RoundRule = Literal["qbst", "spst"]
"""Selection rules of self-training."""

Selection = Literal["most-confident", "least-confident"]
"""End of a class's ranking by confidence that is kept."""

SingleClass = Literal["keep", "drop"]
"""Action if all confident clouds have one class (μ = 0)."""

Rule = Literal["last", "source-val"]
"""Rules that choose a run's network: the last checkpoint, or the most accurate on held-out
source."""

METHODS: dict[str, str] = {"source-only": "qs3.adaptation.method:SourceOnly"}
"""Module and class of each method without rounds; a package that brings methods adds them."""

COMPOSED: dict[str, tuple[str, RoundRule]] = {
    "spst": ("source-only", "spst"),
    "qbst": ("source-only", "qbst"),
}
"""Methods that are a warm-up and a rule of self-training; a package adds those that it brings."""


def split_method(method: str, rounds: str | None = None) -> tuple[str, str | None]:
    """Return the warm-up and the selection rule of a method; ``rounds`` is a requested rule.

    Example:
        >>> split_method("qbst"), split_method("mine:Mine", "spst"), split_method("source-only")
        (('source-only', 'qbst'), ('mine:Mine', 'spst'), ('source-only', None))
    """
    load_names(method, METHODS, COMPOSED)
    if method not in COMPOSED:
        return method, rounds
    warm_up, rule = COMPOSED[method]
    if rounds is not None and rounds != rule:
        raise InputError(
            f"method {method} is {warm_up} with {rule}; for another rule choose method {warm_up} "
            f"with self-training {rounds}"
        )
    return warm_up, rule
