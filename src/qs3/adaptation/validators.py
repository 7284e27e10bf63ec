"""Label-free model selection: scores of a network that need no label of the target (no PyTorch).

Convention:
    Higher is better, for every score. Probabilities are [m k], rows summing to 1; features are
    [m c], as the network pools them. No function takes a label of the target.
"""

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np
from jaxtyping import Float, Int
from scipy.special import xlogy

from qs3.adaptation.density import density_ratio
from qs3.adaptation.graph_labels import check_features, similarities
from qs3.adaptation.priors import check_probabilities
from qs3.errors import InputError
from qs3.models.checks import check_range


@dataclass(frozen=True)
class Observation:
    """What may be seen of a network when it is judged without labels of the target."""

    target_probabilities: Float[np.ndarray, "m k"]
    """Softmax outputs on the target."""
    target_features: Float[np.ndarray, "m c"]
    """Pooled features of the target."""
    validation_probabilities: Float[np.ndarray, "v k"] | None = None
    """Softmax outputs on the held-out part of the source."""
    validation_features: Float[np.ndarray, "v c"] | None = None
    """Pooled features of the held-out part of the source."""
    validation_labels: Int[np.ndarray, "v"] | None = None
    """Classes of the held-out part of the source."""
    training_features: Float[np.ndarray, "s c"] | None = None
    """Pooled features of the source that was trained on."""


def entropy(probabilities: Float[np.ndarray, "m k"]) -> float:
    """Return the negated mean entropy of the predictions, mean_i Σ_c p_ic ln p_ic.

    It rewards a confident collapse to one class.

    Raises:
        InputError: where there is no cloud or rows are not probabilities.

    Example:
        >>> entropy(np.array([[1.0, 0.0], [0.0, 1.0]]))
        0.0
    """
    _check(probabilities)
    return float(_plogp(probabilities).mean())


def information_maximisation(probabilities: Float[np.ndarray, "m k"]) -> float:
    """Return the information that predictions give on clouds, H(mean_i p_i) − mean_i H(p_i).

    From 0, also for a collapse to one class, to ln k. It expects classes of similar size.

    Raises:
        InputError: where there is no cloud or rows are not probabilities.

    Example:
        >>> round(information_maximisation(np.eye(4)), 4)
        1.3863
    """
    _check(probabilities)
    mean = probabilities.mean(axis=0, dtype=np.float64, keepdims=True)
    return float(_plogp(probabilities).mean() - _plogp(mean).sum())


def bnm(probabilities: Float[np.ndarray, "m k"]) -> float:
    """Return the nuclear norm of the prediction matrix (Cui et al., CVPR 2020), scaled to 0..1.

    ‖P‖_* ≤ √min(m, k) ‖P‖_F ≤ √(min(m, k) m); it is divided by this bound, which predictions reach
    that are certain and spread evenly over the classes.

    Raises:
        InputError: where there is no cloud or rows are not probabilities.

    Example:
        >>> round(bnm(np.eye(3)), 12)
        1.0
    """
    _check(probabilities)
    m, k = probabilities.shape
    values = np.linalg.svd(probabilities.astype(np.float64), compute_uv=False)
    return float(values.sum() / np.sqrt(min(m, k) * m))


def snd(features: Float[np.ndarray, "m c"], temperature: float = 0.05) -> float:
    """Return the soft neighbourhood density (Saito et al., ICCV 2021).

    Of rows f scaled to length 1, s_i = softmax_{j ≠ i}(⟨f_i, f_j⟩ / T); the score is the mean
    entropy of s_i. Memory is bounded: a block of rows is held at a time. A single cloud has no
    neighbour and scores 0.

    Args:
        features: Any description of the clouds; the authors take the softmax outputs.
        temperature: T.

    Raises:
        InputError: where there is no cloud, a value is not finite or T is not positive.

    Example:
        >>> round(snd(np.ones((5, 3))), 6) == round(float(np.log(4)), 6)
        True
    """
    if not (temperature > 0 and np.isfinite(temperature)):
        raise InputError(f"temperature must be a positive number, not {temperature}")
    rows = _checked(features, "features")
    if len(rows) == 1:
        return 0.0
    total = 0.0
    for similar in similarities(rows):
        similar -= similar.max(axis=1, keepdims=True)
        similar /= temperature
        share = np.exp(similar)
        similar[share == 0] = 0.0  # of a cloud with itself, which has no part in the mean
        whole = share.sum(axis=1)
        # The entropy of exp(l) / Z is ln Z minus the mean of l.
        total += float((np.log(whole) - np.einsum("ij,ij->i", share, similar) / whole).sum())
    return total / len(rows)


def controlled_risk(weights: Float[np.ndarray, "v"], errors: Float[np.ndarray, "v"]) -> float:
    """Return the importance-weighted risk with its control variate (You et al., ICML 2019, Eq. 8).

    mean(w ℓ) + η mean(w) − η with η = −cov(w ℓ, w) / var(w); 0 where w does not vary.

    Example:
        >>> controlled_risk(np.ones(4), np.array([1.0, 0.0, 0.0, 0.0]))
        0.25
    """
    weighted = weights * errors
    variance = float(np.var(weights))
    covariance = float(np.mean((weighted - weighted.mean()) * (weights - weights.mean())))
    eta = -covariance / variance if variance > 0 else 0.0
    return float(weighted.mean() + eta * weights.mean() - eta)


def dev(
    training_features: Float[np.ndarray, "s c"],
    target_features: Float[np.ndarray, "m c"],
    validation_features: Float[np.ndarray, "v c"],
    validation_probabilities: Float[np.ndarray, "v k"],
    validation_labels: Int[np.ndarray, "v"],
) -> float:
    """Return the negated deep embedded validation risk (You et al., ICML 2019).

    The error rate on the source's held-out clouds, each weighted by how much more frequent its
    features are in the target, with a control variate. It may leave the range 0..1.

    NOTE: the domain classifier is logistic (`qs3.adaptation.density.density_ratio`), its penalty
    chosen on held-out clouds, where the authors train a network with one hidden layer. Where the
    domains hardly overlap in feature space no choice helps: the score varies much.

    Raises:
        InputError: where a set is empty, or a value is not finite.
    """
    _check(validation_probabilities)
    source = _checked(training_features, "training features")
    target = _checked(target_features, "target features")
    points = _checked(validation_features, "validation features")
    weights = density_ratio(source, target, points)
    wrong = validation_probabilities.argmax(axis=1) != validation_labels
    return -controlled_risk(weights, wrong.astype(np.float64))


def class_ami(
    features: Float[np.ndarray, "m c"], predicted: Int[np.ndarray, "m"], k: int, seed: int = 0
) -> float:
    """Return the agreement of predicted classes with clusters (Musgrave et al., 2208.07360).

    Adjusted mutual information (arithmetic mean) of the predictions and of scikit-learn's k-means
    clusters, the best of four starts; no more clusters than distinct features. Where
    all clouds are predicted one class the score is 0, whatever the clusters.

    Args:
        features: Pooled features.
        predicted: Predicted classes.
        k: Number of clusters: the number of classes.
        seed: Start of k-means.

    Raises:
        InputError: where there is no cloud, a value is not finite or k is not at least 1.

    Example:
        >>> points = np.array([[0.0], [0.1], [5.0], [5.1]])
        >>> round(class_ami(points, np.array([1, 1, 0, 0]), 2), 12)
        1.0
    """
    from sklearn.cluster import KMeans
    from sklearn.metrics import adjusted_mutual_info_score

    rows = _checked(features, "features")
    check_range("k", k)
    if len(np.unique(predicted)) < 2:
        return 0.0
    rows = rows - rows.mean(axis=0)
    k = min(k, len(np.unique(rows, axis=0)))
    means = KMeans(k, n_init=4, random_state=seed)  # pyright: ignore[reportArgumentType]
    clusters = means.fit_predict(rows)
    return float(adjusted_mutual_info_score(clusters, predicted))


def source_accuracy(probabilities: Float[np.ndarray, "v k"], labels: Int[np.ndarray, "v"]) -> float:
    """Return the accuracy on the held-out part of the source.

    Raises:
        InputError: where there is no cloud or rows are not probabilities.

    Example:
        >>> source_accuracy(np.eye(2), np.array([0, 0]))
        0.5
    """
    _check(probabilities)
    return float(np.mean(probabilities.argmax(axis=1) == labels))


def _plogp(probabilities: np.ndarray) -> np.ndarray:
    """Return Σ_c p ln p of each row, in double precision."""
    p = np.maximum(probabilities.astype(np.float64), 0.0)
    return xlogy(p, p).sum(axis=1)


def _check(probabilities: np.ndarray) -> None:
    if len(probabilities) == 0:
        raise InputError("there are no clouds to score")
    check_probabilities(probabilities)


def _checked(features: np.ndarray, what: str) -> np.ndarray:
    if len(features) == 0:
        raise InputError(f"{what}: there are no clouds to score")
    check_features(features, what)
    return features.astype(np.float64)


def _of(score: Callable[..., float], *names: str) -> Callable[[Observation], float | None]:
    """Return a score as a function of what is seen; None where part of that is not there."""

    def of_seen(seen: Observation) -> float | None:
        values = [getattr(seen, name) for name in names]
        return None if any(value is None for value in values) else score(*values)

    return of_seen


_HELD = ("validation_probabilities", "validation_labels")
VALIDATORS: Mapping[str, Callable[[Observation], float | None]] = MappingProxyType(
    {
        "source-val": _of(source_accuracy, *_HELD),
        "entropy": _of(entropy, "target_probabilities"),
        "im": _of(information_maximisation, "target_probabilities"),
        "bnm": _of(bnm, "target_probabilities"),
        "snd": _of(snd, "target_probabilities"),
        "dev": _of(dev, "training_features", "target_features", "validation_features", *_HELD),
        "class-ami": _of(
            lambda features, p: class_ami(features, p.argmax(axis=1), p.shape[1]),
            "target_features",
            "target_probabilities",
        ),
    }
)
"""Every label-free score by its name; ``last`` needs none, and the oracle is not one of them."""


def validate(observation: Observation) -> dict[str, float | None]:
    """Return every score of a network; None where the observation lacks what a score needs."""
    return {name: score(observation) for name, score in VALIDATORS.items()}
