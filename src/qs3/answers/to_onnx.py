"""A trained network as one ONNX file, with its normalisation inside."""

import contextlib
import importlib
import json
import logging
import time
import warnings
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor, nn

from qs3.clouds.preparation import LARGEST, PAPER, Preparation
from qs3.errors import InputError, MissingExtraError, QS3Error, without_warnings
from qs3.files import check_output, write_bytes
from qs3.models import PointClassifier
from qs3.runs.bundled import workplace
from qs3.training.predict import LoadedModel, load_model, predict_probabilities
from qs3.training.prepared import normalise_in_a_graph

KEY = "qs3"
CLOUDS = 16
"""Number of random clouds that the file is checked on."""
ROUNDING = 1e-5
"""Largest difference of a probability that rounding alone explains."""
STRAYS = (2, 1e-2)
"""Clouds of the check that may differ by more, and by how much at most: rounding may choose another
neighbour if two are equally far."""


@dataclass(frozen=True)
class Exported:
    """An exported file."""

    path: Path
    difference: float
    seconds: float
    expects: Mapping[str, Any]
    """Steps before the file (docs/export.md)."""


class CloudClassifier(nn.Module):
    """A network that takes clouds in any unit, and returns probabilities.

    The graph normalises the clouds as training does; outliers and the number of points are the
    caller's.
    """

    def __init__(self, model: PointClassifier, preparation: Preparation = PAPER) -> None:
        super().__init__()
        self.model, self.preparation = model, preparation

    def forward(self, points: Float[Tensor, "b n 3"]) -> Float[Tensor, "b k"]:
        """Return the probabilities of the classes."""
        logits = self.model(normalise_in_a_graph(points.double(), self.preparation).float())
        return torch.softmax(logits.double(), dim=1).float()


def export_run(run: Path, out: Path | None = None) -> Exported:
    """Write the network of a run as ONNX, after a check of the file against PyTorch.

    Args:
        run: Folder of the run, its ``.safetensors`` file, or a bundled network.
        out: The file; None takes ``model.onnx`` next to the weights, which a bundled network
            refuses. An earlier export is replaced.
    """
    for package in ("onnx", "onnxscript", "onnxruntime"):
        try:
            importlib.import_module(package)
        except ImportError as error:
            raise MissingExtraError(package, "export", error) from error
    loaded = load_model(run)
    path = workplace(run) / "model.onnx" if out is None else Path(out)
    if path.suffix != ".onnx":
        raise InputError(f"{path}: name a file that ends in .onnx")
    check_output(path, "--out", ".onnx")
    if path.is_file() and not _is_export(path):
        raise InputError(f"{path}: is not an export of qs3; name another file")
    num_points, preparation = loaded.num_points, loaded.preparation
    if num_points is None:
        raise InputError(f"{run}: the number of points per cloud (num_points) is missing")
    expects = {
        "points": num_points,
        "distinct": preparation.counts_points,
        "outliers_removed": preparation.remove_outliers,
        "most": max(LARGEST, num_points),
    }
    facts = {"class_names": loaded.class_names, "settings": loaded.settings, "expects": expects}
    start = time.perf_counter()
    data = _serialise(loaded, num_points, json.dumps(facts, ensure_ascii=False, sort_keys=True))
    seconds = time.perf_counter() - start
    differences = compare(loaded.model, num_points, preparation, data)
    worst, strays = float(differences.max()), int((differences > ROUNDING).sum())
    if not worst <= STRAYS[1] or strays > STRAYS[0]:
        raise QS3Error(
            f"{path}: not written: on {strays} of {CLOUDS} random clouds its probabilities are not "
            f"PyTorch's (difference up to {worst:.1e})"
        )
    write_bytes(path, data)
    return Exported(path, worst, seconds, expects)


def random_clouds(num_points: int) -> Float[np.ndarray, "m n 3"]:
    """Return the clouds of the check: off the origin, and as large as 0.001 to 1000."""
    rng, each = np.random.default_rng(0), (CLOUDS, 1, 3)
    points = rng.normal(size=(CLOUDS, num_points, 3)) * rng.uniform(0.1, 1, size=each)
    points = (points + rng.normal(size=each)) * 10.0 ** rng.uniform(-3, 3, size=(CLOUDS, 1, 1))
    return points.astype(np.float32)


def compare(
    model: PointClassifier, num_points: int, preparation: Preparation, data: bytes
) -> Float[np.ndarray, "m"]:
    """Return the largest difference of a probability from PyTorch's, for each of random clouds."""
    import onnxruntime

    points = random_clouds(num_points)
    same_points = replace(preparation, remove_outliers=False, redraw=False)
    with without_warnings():  # the sizes are drawn here
        wanted = predict_probabilities(model, points, preparation=same_points)
    session = onnxruntime.InferenceSession(data, providers=["CPUExecutionProvider"])
    answers = (session.run(None, {"points": part})[0] for part in (points[:1], points[1:]))
    return np.abs(np.concatenate([np.asarray(part) for part in answers]) - wanted).max(axis=1)


def _is_export(path: Path) -> bool:
    import onnx

    try:
        model = onnx.load(path, load_external_data=False)
    except Exception:  # unreadable, so it is not ours
        return False
    return any(entry.key == KEY for entry in model.metadata_props)


def _serialise(loaded: LoadedModel, num_points: int, facts: str) -> bytes:
    network = CloudClassifier(loaded.model, loaded.preparation).eval().requires_grad_(False)
    # Not of a single cloud, which would fix their number.
    example = torch.zeros(2, num_points, 3)
    try:
        with _quietly(), torch.no_grad():
            clouds = torch.export.Dim("clouds", min=1)
            program = torch.export.export(
                network, (example,), dynamic_shapes=({0: clouds},), strict=False
            )
            exported = torch.onnx.export(
                program,
                dynamo=True,
                input_names=["points"],
                output_names=["probabilities"],
                dynamic_shapes=({0: "clouds"},),
                verbose=False,
            )
            assert exported is not None  # noqa: S101
            exported.model.metadata_props[KEY] = facts
            return exported.model_proto.SerializeToString()
    except Exception as error:
        reason = " ".join(str(error).split())[:200]
        raise QS3Error(
            f"{type(loaded.model).__name__} cannot be exported by PyTorch {torch.__version__}: "
            f"{reason}"
        ) from error


@contextlib.contextmanager
def _quietly() -> Iterator[None]:
    before = logging.root.manager.disable
    logging.disable(logging.WARNING)
    try:
        with warnings.catch_warnings(action="ignore"):
            yield
    finally:
        logging.disable(before)
