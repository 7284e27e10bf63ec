"""What a forest says and what the CAD says, as one probability.

A forest knows how a part looks to a sensor, and fails on other scans than the comparison with CAD
does. Logarithms are added with weights, which simulated scans that the forest did not learn from
choose by maximum likelihood (a multinomial logistic regression on four numbers; Platt, 1999). The
likelihood takes some scans to be spoilt by the simulation, so that the CAD says nothing about them:
otherwise a few of them decide the weights, and the CAD counts for less than on real scans.

The noise of one scan is not known exactly, so ratios of misfits count, not their differences: of
Gaussian noise of unknown size the likelihood is a power of the sum of squares. The misfit counts
noises, along the line of sight larger ones, and forgives what is far off; the residual counts
metres. Each sensor has its own share of both.
"""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np
from jaxtyping import Bool, Float, Int

from qs3.checks import Bounds, Share, check
from qs3.errors import InputError

_LEAST = 1e-9
"""Probability below which a forest says no more."""
_USUAL = np.array([1.0, 3.0, 1.5, 0.5])
"""Weights without scans to measure them on."""
LEAST_MISFIT = 0.5
"""Scans agree no better than this with their CAD."""
_SCRAP = 100.0
"""Points of a scan that says half as much as one of many points. Simulated scans have enough, so
that nothing is measured about scraps on them."""
_TRUST = 2.0
"""Scans that the usual weights count as: few scans without an error would weigh without end."""
_SPOILT = 0.1
"""Share of simulated scans about which the CAD says nothing."""
_TOO_SMALL = 4.0
"""A class whose CAD cannot hold the scan agrees so many times worse than the worst that can."""
_HIGHEST = 50.0
_LEAST_OFF, _MOST_OFF = 0.01, 1e4
"""No scan disagrees less than the former; a scan without a pose disagrees as much as the latter."""
LEAST_RESIDUAL = 2e-4
"""Metres: scans agree no better than this with their CAD."""
_RIGHT, _FEW, _LEAST_EXCESS = 0.97, 10, 0.1
"""Share of simulated scans of right class and pose that are not lost, scans needed to measure it,
and the least excess of a lost scan."""
_FEWEST, _SCANTY = 0.01, 0.9
"""Share of these that show least, and the part of what it shows that a known scan shows."""
_ALL = 10
"""Scans of its own class that say as much about what is typical of it as all classes."""
_SCANS, _OWN, _CLEARLY, _MOST = 20, 5, 0.5, 4.0
"""Scans, and scans of a class, that are needed to show a calm camera, and logarithms that count at
least and at most."""
_CALM, _EACH = 0.1, (0.5, 0.75)
"""Quantiles of scans that must all agree better: the first is that of the best, and is raised by
two standard errors."""
_SHARE = 0.005
"""Share below which nothing is known: there are about a hundred scans."""
_LEVELS = 101
_Weight = Annotated[float, Bounds(high=_HIGHEST)]


@dataclass(frozen=True)
class Fusion:
    """Weights of a forest and of the comparison with CAD, and how well known scans agree."""

    forest: _Weight = float(_USUAL[0])
    """Weight of the logarithm of the forest's probability."""
    witness: _Weight = float(_USUAL[1])
    """Weight of the logarithm of the misfit of the best pose."""
    residual: _Weight = float(_USUAL[2])
    """Weight of the logarithm of its residual."""
    view: _Weight = float(_USUAL[3])
    """Weight of how rare its view is."""
    typical: Mapping[str, float] = field(default_factory=dict)
    """Median logarithm of the disagreement of simulated scans with the CAD of their own class
    (`qs3.parts.locating.Candidate`), by class; of few scans it is drawn towards that of all."""
    misfits: tuple[float, ...] = ()
    """Evenly spaced quantiles of `excess` of simulated scans; empty if none was measured."""
    joint: tuple[float, ...] = ()
    """Quantiles of the sum of the logarithms of two shares of these scans: of those less familiar
    to the forest, and of those that agree less with their CAD (Fisher's combination)."""
    worst: Annotated[float | None, Bounds(above=True)] = None
    """Excess above which a scan is lost; None if too few scans measured it."""
    calm: Annotated[float, Bounds(high=_MOST)] = 0.0
    """By how much scans of the user's camera agree better with their CAD than simulated ones, in
    logarithms; see `of_scans`."""
    shown: Share = 0.0
    """Visible share below which a scan is lost, as a scrap: hardly a simulated scan shows less."""

    def __post_init__(self) -> None:
        check(self, "forest and CAD")
        if not np.isfinite([*self.typical.values()]).all():
            raise InputError("its typical disagreement is not finite")
        for values in (self.misfits, self.joint):
            numbers = np.array(values, dtype=np.float64)
            if not np.isfinite(numbers).all() or (np.diff(numbers) < 0).any():
                raise InputError("its misfits are not in rising order")
        if bool(self.misfits) != bool(self.joint):
            raise InputError("its misfits are incomplete")

    def probabilities(
        self, forest: Float[np.ndarray, "k"], agreed: Float[np.ndarray, "k 3"], points: int
    ) -> Float[np.ndarray, "k"]:
        """Return the probability of each class by both.

        Args:
            forest: Probabilities.
            agreed: Misfit of the best pose of each class, its residual in metres, and how rare its
                view is (`Candidate.surprise`). The first is NaN for a class that was not compared,
                which counts as the worst of the others; ∞ for one whose CAD cannot hold the scan,
                which counts as clearly worse. If no CAD can hold it, all classes are as likely.
            points: Number of distinct points of the scan.
        """
        features = _features(forest[None], agreed[None], np.array([points]))[0]
        logits = features @ (self.forest, self.witness, self.residual, self.view)
        return np.exp(logits - np.logaddexp.reduce(logits))

    def excess(self, class_name: str, disagreement: float) -> float:
        """Return by how much, in logarithms, a pose disagrees more than is typical of its class.

        Args:
            class_name: The class.
            disagreement: Of the best pose of the class; infinite without one.
        """
        return _excess(disagreement, self.typical.get(class_name)) + self.calm

    def of_scans(self, found: Sequence[tuple[str, float]]) -> "Fusion":
        """Return the same for a user's scans, which need no labels.

        If their camera is calmer than the simulated one, foreign parts agree as well as simulated
        scans of known ones do. Limits are tightened by as much as scans agree better throughout:
        the best tenth (less what chance may do), half and three quarters of them, and half of those
        of each class. So they stay if four in ten scans, or a class, agree no better. They
        are never widened: what a noisier camera does to known parts, foreign parts and other sizes
        do as well. Fewer than 20 scans show nothing.

        Args:
            found: Answered class and disagreement of each scan; infinite without a pose.
        """
        plain, count = replace(self, calm=0.0), len(found)
        if not self.misfits or count < _SCANS:
            return plain
        excess = np.array([plain.excess(*scan) for scan in found])
        names = np.array([name for name, _ in found])
        best = _CALM + 2 * (_CALM * (1 - _CALM) / count) ** 0.5
        pairs = [(_CALM, np.quantile(excess, best))]
        pairs += [(share, np.quantile(excess, share)) for share in _EACH]
        for name, scans in zip(*np.unique(names, return_counts=True), strict=True):
            if scans >= _OWN:
                pairs.append((0.5, np.median(excess[names == name])))
        calm = min(float(np.quantile(self.misfits, share) - value) for share, value in pairs)
        return replace(plain, calm=min(calm, _MOST)) if calm > _CLEARLY else plain

    def familiarity(self, familiar: float, class_name: str, disagreement: float) -> float:
        """Return the share of known scans that are less familiar by forest and CAD together.

        Args:
            familiar: The same share by the forest alone.
            class_name: The answered class.
            disagreement: Of its best pose; infinite without one.
        """
        if not self.misfits:
            return familiar
        agreed = _share_above(self.misfits, self.excess(class_name, disagreement))
        return float(np.interp(_joined(familiar, agreed), self.joint, _levels(self.joint)))

    def lost(self, class_name: str, disagreement: float, visible: float = 1.0) -> bool | None:
        """Whether a pose is no good for a class, as hardly any right one; None if not measured."""
        if self.worst is None:
            return None
        beyond = np.isinf(disagreement) or visible < self.shown
        return bool(beyond) or self.excess(class_name, disagreement) > self.worst

    def of_shown(self, found: Iterable[tuple[str, float, float]]) -> "Fusion":
        """Return the same that knows the visible shares of simulated scans of right pose.

        Of each scan it takes the class, the disagreement and the visible share; lost ones are left
        out.
        """
        visible = [scan[2] for scan in found if not self.lost(*scan[:2])]
        few = self.worst is None or len(visible) < _FEW
        return self if few else replace(self, shown=_SCANTY * float(np.quantile(visible, _FEWEST)))


@dataclass(frozen=True)
class Judged:
    """What forest and CAD say about simulated scans that the forest did not learn from."""

    class_names: tuple[str, ...]
    labels: Int[np.ndarray, "s"]
    points: Int[np.ndarray, "s"]
    """Number of distinct points."""
    forest: Float[np.ndarray, "s k"]
    """Probabilities."""
    familiar: Float[np.ndarray, "s"]
    agreed: Float[np.ndarray, "s k 3"]
    """As in `Fusion.probabilities`; one is known of each scan."""
    disagreement: Float[np.ndarray, "s k"]
    """Of the best pose of each class; infinite without one."""
    posed: Bool[np.ndarray, "s"]
    """Whether the best pose of its class is right, as far as that is known. What is said of the
    others belongs to *lost*, whatever their class."""


def measure_fusion(judged: Judged) -> Fusion:
    """Weigh forest and CAD, and measure how well known scans agree with both."""
    names, rows = judged.class_names, np.arange(len(judged.labels))
    features = _features(judged.forest, judged.agreed, judged.points)
    weights = _weights(features, judged.labels)
    answers = (features @ weights).argmax(axis=1)
    true = judged.disagreement[rows, judged.labels]
    labels = judged.labels[np.isfinite(true)]
    logs = np.log(np.maximum(true[np.isfinite(true)], _LEAST_OFF))
    typical = {}
    for k in range(len(names) if len(logs) else 0):
        some = logs[labels == k]
        middle = float(np.median(some)) if len(some) else 0.0
        typical[names[k]] = float(np.average([middle, np.median(logs)], weights=[len(some), _ALL]))
    off = judged.disagreement[rows, answers]
    usual = [typical.get(names[k]) for k in answers]
    excess = [*map(_excess, off, usual)]
    right = (answers == judged.labels) & np.isfinite(off) & judged.posed
    worst, right = None, np.array(excess)[right]
    if len(right) >= _FEW:  # a quantile of few scans is uncertain
        worst = (1 + 2 / len(right) ** 0.5) * max(float(np.quantile(right, _RIGHT)), _LEAST_EXCESS)
    misfits = _quantiles(np.array(excess))
    agreed = [_share_above(misfits, value) for value in excess]
    joint = [_joined(*both) for both in zip(judged.familiar.tolist(), agreed, strict=True)]
    forest, witness, residual, view = map(float, weights)
    joined = _quantiles(np.array(joint))
    return Fusion(forest, witness, residual, view, typical, misfits, joined, worst)


def _excess(disagreement: float, typical: float | None) -> float:
    usual = 0.0 if typical is None else typical
    return float(np.log(np.clip(disagreement, _LEAST_OFF, _MOST_OFF)) - usual)


def _joined(familiar: float, agreed: float) -> float:
    return float(np.log(max(familiar, _SHARE)) + np.log(max(agreed, _SHARE)))


def _features(
    forest: np.ndarray, agreed: np.ndarray, points: np.ndarray
) -> Float[np.ndarray, "s k 4"]:
    misfit, residual, surprise = np.moveaxis(agreed, 2, 0)
    seen = np.isfinite(misfit)
    none = np.where(np.isinf(misfit) & seen.any(axis=1, keepdims=True), _TOO_SMALL, 1.0)
    features = [np.log(np.maximum(forest, _LEAST))]
    for values, least in ((misfit, LEAST_MISFIT), (residual, LEAST_RESIDUAL)):
        known = np.maximum(np.where(seen, values, 0.0), least)
        features.append(-np.log(np.where(seen, known, none * known.max(axis=1, keepdims=True))))
    known = np.where(seen, surprise, -np.inf)
    known = np.where(seen, known, np.where(seen.any(axis=1), known.max(axis=1), 0.0)[:, None])
    features.append(-known)
    too_large = np.isinf(misfit).any(axis=1) & ~seen.any(axis=1)  # no CAD can hold the scan
    weight = np.where(too_large, 0.0, points / (points + _SCRAP))
    return np.stack(features, axis=2) * weight[:, None, None]


def _weights(features: np.ndarray, labels: np.ndarray) -> Float[np.ndarray, "4"]:
    """Return the weights of greatest likelihood, with the usual ones as a weak prior."""
    from scipy.optimize import minimize  # slow to load, and only a training needs it

    rows = np.arange(len(labels))

    def likelihood(logits: np.ndarray) -> np.ndarray:
        return logits[rows, labels] - np.logaddexp.reduce(logits, axis=1)

    alone = likelihood(features[:, :, 0]) + np.log(_SPOILT)

    def loss(logarithms: np.ndarray) -> float:
        both = likelihood(features @ np.exp(logarithms)) + np.log1p(-_SPOILT)
        prior = _TRUST * ((logarithms - np.log(_USUAL)) ** 2).sum()
        return float(prior - np.logaddexp(both, alone).sum())

    ends = [(np.log(0.02), np.log(_HIGHEST))] * len(_USUAL)
    found = minimize(loss, np.log(_USUAL), method="L-BFGS-B", bounds=ends)
    return np.exp(np.asarray(found.x))


def _share_above(quantiles: Sequence[float], value: float) -> float:
    return float(np.interp(value, quantiles, _levels(quantiles)[::-1]))


def _levels(quantiles: Sequence[float]) -> Float[np.ndarray, "q"]:
    return np.linspace(0, 1, len(quantiles))


def _quantiles(values: np.ndarray) -> tuple[float, ...]:
    return tuple(np.quantile(values, np.linspace(0, 1, _LEVELS)).tolist())
