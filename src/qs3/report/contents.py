"""What a page holds: plain arrays, scores and mappings, nothing of the run itself."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int

from qs3.errors import InputError
from qs3.evaluation.records import DataRecord, Scores
from qs3.report.lines import ScoreLine
from qs3.report.montage import MontageView
from qs3.report.plots import Curve, SelectionRound


@dataclass(frozen=True)
class Scored:
    """How one network scored on the target's test clouds."""

    name: str
    """Name of the method, such as ``source-only``."""
    scores: Scores
    """Its scores."""
    right: Bool[np.ndarray, "b"] | None = None
    """Whether each test cloud was right, where both networks saw the clouds in the same order; with
    it for both networks the report compares them cloud by cloud."""

    def __post_init__(self) -> None:
        if self.right is not None and (len(self.right), int(self.right.sum())) != (
            self.scores.clouds,
            self.correct,
        ):
            raise InputError(f"{self.name}: `right` and the confusion matrix disagree")

    @property
    def matrix(self) -> Int[np.ndarray, "k columns"]:
        """Counts [true, predicted]; the last column counts answers that are none of the classes."""
        return np.array(self.scores.confusion)

    @property
    def correct(self) -> int:
        """Number of right predictions."""
        return int(self.matrix.diagonal().sum())

    @property
    def recall(self) -> Float[np.ndarray, "k"]:
        """Accuracy of each class; NaN for a class without a cloud."""
        return np.array(self.scores.per_class, dtype=np.float64)


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
class Report:
    """Everything one page tells. Parts that are left empty are left out of the page."""

    title: str
    """Heading of the page."""
    summary: str
    """What was run, in a sentence or two."""
    class_names: tuple[str, ...]
    """Names of the classes, in the order of the confusion matrices."""
    command: str = ""
    """Command that makes this report again."""
    before: Scored | None = None
    """The network before adaptation."""
    after: Scored | None = None
    """The adapted network, on the same clouds; or the only one there is."""
    settings: Mapping[str, Any] = field(default_factory=dict)
    """Settings of the run; mappings inside become groups."""
    versions: Mapping[str, str] = field(default_factory=dict)
    """Versions of the software."""
    montage: MontageView | None = None
    """One scan through the whole sensor."""
    montage_title: str = ""
    """What was scanned, by which sensor."""
    data: Mapping[str, DataRecord] = field(default_factory=dict)
    """What the runs read, by role: source, target or test."""
    clouds: Mapping[str, Sequence[Cloud]] = field(default_factory=dict)
    """Clouds to look at, by domain."""
    mistakes: Mapping[str, Sequence[Cloud]] = field(default_factory=dict)
    """Clouds of the target that the network is surest of and gets wrong, the surest first, and
    beside each the scan of the source nearest to it: columns of the same length, by heading."""
    nearest: Mapping[str, Sequence[Cloud]] = field(default_factory=dict)
    """The same of clouds of the target whether they are right or not."""
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
    notes: tuple[str, ...] = ()
    """Further remarks for the reader, below the verdict."""

    def __post_init__(self) -> None:
        counts = [network.matrix.sum(axis=1).tolist() for network in self.networks]
        for network, own in zip(self.networks, counts, strict=True):
            if len(own) != len(self.class_names):
                raise InputError(f"{network.name}: not scored on {len(self.class_names)} classes")
        if len(counts) == 2 and counts[0] != counts[1]:
            first, second = self.networks
            raise InputError(
                f"{first.name} was scored on {counts[0]} clouds of the classes and {second.name} "
                f"on {counts[1]}; score both on the same clouds"
            )

    @property
    def networks(self) -> tuple[Scored, ...]:
        """The networks that were scored, the one before adaptation first."""
        return tuple(network for network in (self.before, self.after) if network is not None)
