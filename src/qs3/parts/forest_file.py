"""A forest as one safetensors file: arrays and JSON; nothing is ever unpickled."""

import json
from collections.abc import Mapping
from dataclasses import fields
from pathlib import Path
from typing import Any

import numpy as np
import safetensors
import safetensors.numpy

from qs3.errors import InputError
from qs3.files import parse_json, write_bytes
from qs3.meshes.classes import check_class_names
from qs3.parts.descriptor import WIDTH
from qs3.parts.forest import Forest
from qs3.reading import reading

FORMAT = 2
_TYPES = {"threshold": np.float64, "value": np.float32}
_ARRAYS = {
    field.name: np.dtype(_TYPES.get(field.name, np.int32))
    for field in fields(Forest)
    if field.name not in ("class_names", "width")
}


def save_forest(path: Path, forest: Forest, facts: Mapping[str, Any]) -> None:
    """Write a forest and further JSON facts to one file, atomically."""
    arrays = {n: np.ascontiguousarray(getattr(forest, n), kind) for n, kind in _ARRAYS.items()}
    own = {"format": FORMAT, "class_names": list(forest.class_names), "width": forest.width}
    metadata = {"qs3": json.dumps({**facts, **own}, allow_nan=False)}
    write_bytes(path, safetensors.numpy.save(arrays, metadata))


def read_forest(path: Path) -> tuple[Forest, dict[str, Any]]:
    """Read a forest and the facts in its file."""
    with reading(path, "a forest of qs3"):
        with safetensors.safe_open(path, framework="numpy") as handle:  # pyright: ignore[reportPrivateImportUsage]
            facts = parse_json((handle.metadata() or {})["qs3"], path)
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
