"""The forest: extremely randomised trees on descriptors, and its file.

Source: Geurts et al., Extremely randomized trees, 2006. scikit-learn grows the trees; they are kept
as arrays, so that prediction needs only NumPy, and the file holds arrays and JSON alone: nothing is
ever unpickled.
"""

from collections import defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float32, Int32, Int64

from qs3.errors import InputError
from qs3.files import open_arrays, write_arrays
from qs3.meshes.classes import check_class_names
from qs3.parts.descriptor import WIDTH

TREES, LEAF = 200, 2
FORMAT = 2
"""Of the file."""
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
        """Return the probability of each class: the mean over the trees, and never 0."""
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


_TYPES = {"threshold": np.float64, "value": np.float32}  # sklearn's own for a threshold
_ARRAYS = {
    field.name: np.dtype(_TYPES.get(field.name, np.int32))
    for field in fields(Forest)
    if field.name not in ("class_names", "width")
}


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
    which share its weight, 1 by default. Fewer than two classes, and a class without a cloud, raise
    `InputError`.
    """
    from sklearn.ensemble import ExtraTreesClassifier

    shares = np.ones(len(labels)) if weights is None else np.asarray(weights, dtype=np.float64)
    require_classes(labels, class_names)
    totals = np.bincount(labels, weights=shares, minlength=len(class_names))
    balanced = shares / totals[labels] * (len(labels) / len(totals))
    trees = ExtraTreesClassifier(TREES, min_samples_leaf=LEAF, random_state=seed, n_jobs=1)
    copies, _, width = descriptors.shape
    rows = descriptors.reshape(-1, width).astype(np.float32)
    trees.fit(rows, np.tile(labels, copies), sample_weight=np.tile(balanced, copies) / copies)
    return Forest(tuple(class_names), width, **_arrays(trees))


def require_classes(labels: Int64[np.ndarray, "b"], class_names: Sequence[str]) -> None:
    """Refuse fewer than two classes, and a class without a cloud."""
    if len(class_names) < 2:
        raise InputError("a forest needs clouds of at least two classes")
    counts = np.bincount(labels, minlength=len(class_names))
    if not counts.all():
        raise InputError(f"class {class_names[int(counts.argmin())]} has no cloud to learn from")


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
    arrays = {n: np.concatenate(p).astype(_TYPES.get(n, np.int32)) for n, p in parts.items()}
    return arrays | {"roots": np.array(roots, dtype=np.int32)}


def save_forest(path: Path, forest: Forest, facts: Mapping[str, Any]) -> None:
    """Write a forest and further JSON facts to one file, atomically."""
    arrays = {n: np.ascontiguousarray(getattr(forest, n), kind) for n, kind in _ARRAYS.items()}
    described = {"format": FORMAT, "class_names": list(forest.class_names), "width": forest.width}
    write_arrays(path, arrays, {**facts, **described})


def read_forest(path: Path) -> tuple[Forest, dict[str, Any]]:
    """Read a forest and the facts in its file."""
    with open_arrays(path, "a forest of qs3") as (handle, facts):
        arrays = {name: handle.get_tensor(name) for name in handle.keys()}  # noqa: SIM118
        fault = _fault(facts, arrays)
        if fault:
            raise InputError(f"not a forest of this version: {fault}")
    return Forest(tuple(facts["class_names"]), facts["width"], **arrays), facts


def _fault(facts: Any, arrays: Mapping[str, np.ndarray]) -> str:
    """Return a fault by which a forest would predict wrongly or not stop; empty if none."""
    if not isinstance(facts, dict) or facts.get("format") != FORMAT:
        return f"the format is not {FORMAT}"
    names = check_class_names(facts.get("class_names"))
    if len(names) < 2:
        return "it has only one class"
    width = facts.get("width")
    if type(width) is not int or width != WIDTH:
        return f"it reads {width} numbers of a cloud, not {WIDTH}"
    if {name: array.dtype for name, array in arrays.items()} != _ARRAYS:
        return "arrays are missing or of another type"
    nodes = arrays["feature"].size
    shapes = dict.fromkeys(("feature", "threshold", "left", "right"), (nodes,))
    shapes |= {"value": (nodes, len(names)), "roots": (arrays["roots"].size,)}
    if {name: array.shape for name, array in arrays.items()} != shapes or not arrays["roots"].size:
        return "arrays do not fit each other"
    if not all(np.isfinite(array).all() for array in arrays.values()):
        return "a number is not finite"
    value = arrays["value"].astype(np.float64)
    if (value < 0).any() or not np.allclose(value.sum(axis=1), 1, rtol=0, atol=1e-3):
        return "shares of the classes do not add up to 1"
    inner = arrays["feature"] >= 0
    place = np.arange(nodes)
    # A child comes after its parent, so that every walk ends.
    for name in ("left", "right"):
        child = arrays[name][inner]
        if (child <= place[inner]).any() or (child >= nodes).any():
            return f"an index of {name} is out of range"
    ranges = {"feature": (-1, width), "roots": (0, nodes)}
    for name, (low, high) in ranges.items():
        if (arrays[name] < low).any() or (arrays[name] >= high).any():
            return f"an index of {name} is out of range"
    return ""
