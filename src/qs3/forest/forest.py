"""The forest: extremely randomised trees and a linear rule on descriptors, averaged.

Source: Geurts et al., Extremely randomized trees, 2006. scikit-learn grows the trees; they are kept
as arrays, so that a file of them holds data alone and predicting needs NumPy alone.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Int32, Int64

from qs3.errors import InputError

TREES, LEAF = 500, 2
_SHRINKAGE = 0.6
"""Of the pooled covariance towards the identity: scans of a few dozen clouds a class are few for 60
features, and real clouds differ from all of them."""
_RULE, _LEAST = 0.3, 1e-3


@dataclass(frozen=True)
class Forest:
    """A trained forest."""

    class_names: tuple[str, ...]
    up: bool
    """Whether z is the vertical of the clouds that it reads."""
    feature: Int32[np.ndarray, "m"]
    """Feature that a node looks at; -1 at a leaf."""
    threshold: Float[np.ndarray, "m"]
    """A cloud goes left if its feature is at most this."""
    left: Int32[np.ndarray, "m"]
    right: Int32[np.ndarray, "m"]
    value: Float32[np.ndarray, "m k"]
    """Shares of the classes at each node."""
    roots: Int32[np.ndarray, "t"]
    """First node of each tree."""
    weights: Float[np.ndarray, "k f"]
    """Linear rule: logits are descriptor @ weights.T + bias."""
    bias: Float[np.ndarray, "k"]

    def predict_proba(self, descriptors: Float[np.ndarray, "b f"]) -> Float[np.ndarray, "b k"]:
        """Return the probability of each class.

        It is proportional to the trees' share times the linear rule's probability to the power 0.3:
        the rule is surer of itself than it is right.
        """
        logits = descriptors @ self.weights.T + self.bias
        logits -= np.logaddexp.reduce(logits, axis=1, keepdims=True)
        logits = _RULE * logits + np.log(self._trees(descriptors.astype(np.float32)) + _LEAST)
        logits -= np.logaddexp.reduce(logits, axis=1, keepdims=True)
        return np.exp(logits)

    def _trees(self, descriptors: np.ndarray) -> np.ndarray:
        rows = np.arange(len(descriptors))[:, None]
        node = np.broadcast_to(self.roots, (len(descriptors), len(self.roots)))
        while True:
            feature = self.feature[node]
            if (feature < 0).all():
                return self.value[node].mean(axis=1)
            goes_left = descriptors[rows, feature] <= self.threshold[node]
            below = np.where(goes_left, self.left[node], self.right[node])
            node = np.where(feature < 0, node, below)


def fit_forest(
    descriptors: Float[np.ndarray, "b f"],
    labels: Int64[np.ndarray, "b"],
    class_names: tuple[str, ...],
    weights: Float[np.ndarray, "b"] | None = None,
    *,
    up: bool = True,
    seed: int = 0,
) -> Forest:
    """Fit trees and the linear rule; classes weigh alike, however many clouds they have.

    Args:
        descriptors: Of `qs3.forest.describe`.
        labels: Index of each cloud's class.
        class_names: Names of the classes; each needs a cloud.
        weights: Weight of each cloud; 1 by default.
        up: Whether z is the vertical in the clouds.
        seed: Of the trees.

    Raises:
        InputError: If a class has no cloud, or there is one class alone.
    """
    from sklearn.ensemble import ExtraTreesClassifier

    given = np.ones(len(labels)) if weights is None else np.asarray(weights, dtype=np.float64)
    totals = np.bincount(labels, weights=given, minlength=len(class_names))
    if len(totals) < 2:
        raise InputError("a forest needs clouds of two classes at least")
    if not totals.all():
        raise InputError(f"class {class_names[int(np.argmin(totals))]} has no cloud to learn from")
    balanced = given * (totals.sum() / len(totals) / totals)[labels]
    trees = ExtraTreesClassifier(TREES, min_samples_leaf=LEAF, random_state=seed, n_jobs=1)
    trees.fit(descriptors.astype(np.float32), labels, sample_weight=balanced)
    coefficients, bias = _linear(descriptors, labels, balanced, len(class_names))
    return Forest(tuple(class_names), up, **_arrays(trees), weights=coefficients, bias=bias)


def _linear(
    descriptors: np.ndarray, labels: np.ndarray, weights: np.ndarray, classes: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return weights and bias of linear discriminant analysis with equal priors.

    The covariance is pooled over the classes and shrunk (Friedman, Regularized discriminant
    analysis, 1989), on standardised features, so that none counts for its unit.
    """
    mean = np.average(descriptors, axis=0, weights=weights)
    scale = np.sqrt(np.average((descriptors - mean) ** 2, axis=0, weights=weights))
    scale = np.where(scale > 1e-9, scale, 1.0)
    scaled = (descriptors - mean) / scale
    means = np.stack(
        [
            np.average(scaled[labels == k], axis=0, weights=weights[labels == k])
            for k in range(classes)
        ]
    )
    left = (scaled - means[labels]) * np.sqrt(weights / weights.mean())[:, None]
    covariance = left.T @ left / len(left)
    identity = np.eye(len(covariance)) * np.trace(covariance) / len(covariance)
    covariance = (1 - _SHRINKAGE) * covariance + _SHRINKAGE * identity
    directions = np.linalg.solve(covariance, means.T).T
    bias = -0.5 * np.einsum("kf,kf->k", directions, means)
    return directions / scale, bias - (directions / scale) @ mean


def _arrays(trees: Any) -> dict[str, np.ndarray]:
    """Return the nodes of all trees one after the other."""
    parts: dict[str, list[np.ndarray]] = {
        name: [] for name in ("feature", "threshold", "left", "right", "value")
    }
    roots, start = [], 0
    for estimator in trees.estimators_:
        tree = estimator.tree_
        leaf = tree.children_left < 0
        shares = tree.value[:, 0]
        parts["feature"].append(np.where(leaf, -1, tree.feature))
        parts["threshold"].append(np.where(leaf, 0, tree.threshold))
        parts["left"].append(np.where(leaf, 0, tree.children_left + start))
        parts["right"].append(np.where(leaf, 0, tree.children_right + start))
        parts["value"].append(shares / shares.sum(axis=1, keepdims=True))
        roots.append(start)
        start += tree.node_count
    types = {"threshold": np.float64, "value": np.float32}  # sklearn's own for a threshold
    arrays = {n: np.concatenate(p).astype(types.get(n, np.int32)) for n, p in parts.items()}
    return arrays | {"roots": np.array(roots, dtype=np.int32)}
