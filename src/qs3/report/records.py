"""What a report is told: plain arrays and mappings, nothing of the run itself."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from qs3.errors import InputError
from qs3.evaluation.metrics import wilson_interval
from qs3.visualisation import Curve, MontageView, SelectionRound


@dataclass(frozen=True)
class Outcome:
    """How one model scored on the target's test clouds.

    Example:
        >>> outcome = Outcome("source-only", np.array([[3, 1], [0, 4]]))
        >>> outcome.correct, outcome.total, outcome.accuracy, outcome.class_mean_accuracy
        (7, 8, 0.875, 0.875)
    """

    name: str
    """Name of the method, such as ``source-only``."""
    confusion: Int[np.ndarray, "k columns"]
    """Counts by true (rows) and predicted class. Predictions of none of the classes go into one
    column more; a cloud in no column would be missing from the score."""
    right: Bool[np.ndarray, "b"] | None = None
    """Whether each test cloud was right, where both models saw the clouds in the same order; with
    it for both models the report compares them cloud by cloud."""

    def __post_init__(self) -> None:
        rows, columns = self.confusion.shape
        if columns not in (rows, rows + 1) or not self.total:
            raise InputError(
                f"{self.name}: a confusion matrix [{rows} {columns}] of {self.total} clouds cannot "
                "be reported; hand in [k k] or [k k+1] counts of at least one cloud"
            )
        if self.right is not None and (len(self.right), int(self.right.sum())) != (
            self.total,
            self.correct,
        ):
            raise InputError(f"{self.name}: `right` and the confusion matrix disagree")

    @property
    def total(self) -> int:
        """Number of test clouds."""
        return int(self.confusion.sum())

    @property
    def correct(self) -> int:
        """Number of right predictions."""
        return int(self.confusion.diagonal().sum())

    @property
    def accuracy(self) -> float:
        """Share of the clouds that is right."""
        return self.correct / self.total

    @property
    def interval(self) -> tuple[float, float]:
        """Wilson's 95 % interval of the accuracy."""
        return wilson_interval(self.correct, self.total)

    @property
    def class_accuracy(self) -> Float[np.ndarray, "k"]:
        """Accuracy of each class; NaN for a class without a cloud."""
        counts = self.confusion.sum(axis=1)
        right = self.confusion.diagonal().astype(np.float64)
        return np.divide(right, counts, out=np.full(len(counts), np.nan), where=counts > 0)

    @property
    def class_mean_accuracy(self) -> float:
        """Mean accuracy of the classes that have a cloud."""
        return float(np.nanmean(self.class_accuracy))


@dataclass(frozen=True)
class Report:
    """Everything one page tells. Parts that are left empty are left out of the page."""

    title: str
    """Heading of the page."""
    summary: str
    """What was run, in a sentence or two."""
    class_names: tuple[str, ...]
    """Names of the classes, in the order of the confusion matrices."""
    before: Outcome
    """The model before adaptation."""
    after: Outcome
    """The adapted model, on the same clouds."""
    command: str
    """Command that makes this report again."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Settings of the run; mappings inside become groups."""
    versions: Mapping[str, str] = field(default_factory=dict)
    """Versions of the software and kind of the machine."""
    montage: MontageView | None = None
    """One scan through the whole sensor."""
    samples: Mapping[str, Mapping[str, Sequence[np.ndarray]]] = field(default_factory=dict)
    """Sample clouds [n 3], z up, by domain and class."""
    curves: tuple[Curve, ...] = ()
    """Losses and scores over epochs."""
    marks: tuple[float, ...] = ()
    """Epochs at which rounds begin."""
    rounds: tuple[SelectionRound, ...] = ()
    """What each round of self-training selected."""
    agreement_meaning: str = ""
    """One sentence on what `SelectionRound.agreement` measures."""
    notes: tuple[str, ...] = ()
    """Further remarks for the reader, below the verdict."""

    def __post_init__(self) -> None:
        k = len(self.class_names)
        for outcome in (self.before, self.after):
            if len(outcome.confusion) != k:
                raise InputError(f"{outcome.name}: its confusion matrix is not of {k} classes")
        before, after = (o.confusion.sum(axis=1).tolist() for o in (self.before, self.after))
        if before != after:
            raise InputError(
                f"{self.before.name} was scored on {before} clouds of the classes and "
                f"{self.after.name} on {after}; score both on the same clouds"
            )
