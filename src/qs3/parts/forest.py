"""The forest: extremely randomised trees on descriptors.

Source: Geurts et al., Extremely randomized trees, 2006. scikit-learn grows the trees; they are kept
as arrays, so that their file holds only data and prediction needs only NumPy.
"""

from collections import defaultdict
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Int32, Int64

from qs3.errors import InputError

TREES, LEAF = 200, 2
_LEAST = 1e-3
"""Added to each share, so that no class is impossible."""


@dataclass(frozen=True)
class Forest:
    """A trained forest."""

    class_names: tuple[str, ...]
    width: int
    feature: Int32[np.ndarray, "m"]
    """Feature that a node tests; -1 at a leaf."""
    threshold: Float[np.ndarray, "m"]
    """A cloud goes left if its feature is at most this."""
    left: Int32[np.ndarray, "m"]
    right: Int32[np.ndarray, "m"]
    value: Float32[np.ndarray, "m k"]
    roots: Int32[np.ndarray, "t"]

    def predict_proba(self, descriptors: Float[np.ndarray, "b f"]) -> Float[np.ndarray, "b k"]:
        """Return the probability of each class: the mean over the trees."""
        shares = self._trees(descriptors.astype(np.float32)) + _LEAST
        return shares / shares.sum(axis=1, keepdims=True)

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
    descriptors: Float[np.ndarray, "v b f"],
    labels: Int64[np.ndarray, "b"],
    class_names: tuple[str, ...],
    weights: Float[np.ndarray, "b"] | None = None,
    *,
    seed: int = 0,
) -> Forest:
    """Fit the trees; all classes have equal weight, and each needs at least one cloud.

    ``descriptors`` are those of each cloud and its varied copies (`qs3.parts.describe_varied`),
    which share its weight, 1 by default.
    """
    from sklearn.ensemble import ExtraTreesClassifier

    given = np.ones(len(labels)) if weights is None else np.asarray(weights, dtype=np.float64)
    totals = np.bincount(labels, weights=given, minlength=len(class_names))
    if len(totals) < 2:
        raise InputError("a forest needs clouds of at least two classes")
    if not totals.all():
        raise InputError(f"class {class_names[int(np.argmin(totals))]} has no cloud to learn from")
    balanced = given / totals[labels] * (len(labels) / len(totals))
    trees = ExtraTreesClassifier(TREES, min_samples_leaf=LEAF, random_state=seed, n_jobs=1)
    copies, _, width = descriptors.shape
    rows = descriptors.reshape(-1, width).astype(np.float32)
    trees.fit(rows, np.tile(labels, copies), sample_weight=np.tile(balanced, copies) / copies)
    return Forest(tuple(class_names), width, **_arrays(trees))


def _arrays(trees: Any) -> dict[str, np.ndarray]:
    parts, roots, start = defaultdict[str, list[np.ndarray]](list), [], 0
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
