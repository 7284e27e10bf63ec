"""What a report is told: plain arrays and mappings, nothing of the run itself."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from qs3.errors import InputError
from qs3.evaluation.metrics import wilson_interval
from qs3.report.montage import MontageView
from qs3.report.plots import Curve, SelectionRound
from qs3.report.scores import ScoreLine


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
class Cloud:
    """One cloud that the reader can turn."""

    points: Float[np.ndarray, "n 3"]
    """Points, z up; each cloud is fitted to its picture."""
    class_name: str
    """Its true class."""
    note: str = ""
    """What stands below it, such as what the networks took it for."""


@dataclass(frozen=True)
class FeatureMap:
    """Features of one network in the plane."""

    name: str
    """Name of the network."""
    positions: Float[np.ndarray, "b 2"]
    """Where each cloud lies."""
    labels: Int[np.ndarray, "b"]
    """Classes, by index."""
    domains: tuple[str, ...]
    """Domain of each cloud."""


@dataclass(frozen=True)
class DataLine:
    """Data that a run read."""

    role: str
    """Source, target or test."""
    name: str
    """Name of the data set with its split."""
    clouds: int
    """Number of clouds."""
    checksum: str
    """SHA-256 over what was read."""


@dataclass(frozen=True)
class Report:
    """Everything one page tells. Parts that are left empty are left out of the page."""

    title: str
    """Heading of the page."""
    summary: str
    """What was run, in a sentence or two."""
    class_names: tuple[str, ...]
    """Names of the classes, in the order of the confusion matrices."""
    command: str
    """Command that makes this report again."""
    before: Outcome | None = None
    """The model before adaptation."""
    after: Outcome | None = None
    """The adapted model, on the same clouds; or the only one there is."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Settings of the run; mappings inside become groups."""
    versions: Mapping[str, str] = field(default_factory=dict)
    """Versions of the software and kind of the machine."""
    montage: MontageView | None = None
    """One scan through the whole sensor."""
    montage_title: str = ""
    """What was scanned, by which sensor."""
    data: tuple[DataLine, ...] = ()
    """What the runs read."""
    clouds: Mapping[str, Sequence[Cloud]] = field(default_factory=dict)
    """Clouds to look at, by domain."""
    maps: tuple[FeatureMap, ...] = ()
    """Features of the networks, before and after."""
    scores: tuple[ScoreLine, ...] = ()
    """Lines of the table of all records."""
    published_source: str = ""
    """Where `ScoreLine.published` was printed."""
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
        outcomes = self.outcomes
        for outcome in outcomes:
            if len(outcome.confusion) != k:
                raise InputError(f"{outcome.name}: its confusion matrix is not of {k} classes")
        counts = [outcome.confusion.sum(axis=1).tolist() for outcome in outcomes]
        if len(outcomes) == 2 and counts[0] != counts[1]:
            raise InputError(
                f"{outcomes[0].name} was scored on {counts[0]} clouds of the classes and "
                f"{outcomes[1].name} on {counts[1]}; score both on the same clouds"
            )

    @property
    def outcomes(self) -> tuple[Outcome, ...]:
        """The models that were scored, the one before adaptation first."""
        return tuple(outcome for outcome in (self.before, self.after) if outcome is not None)
