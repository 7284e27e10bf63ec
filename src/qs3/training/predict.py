"""Load a network, and predict the class probabilities of clouds."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from jaxtyping import Float
from torch import Tensor

from qs3.clouds.preparation import PAPER, Preparation
from qs3.clouds.types import UnlabelledClouds
from qs3.errors import InputError
from qs3.meshes.classes import check_class_names
from qs3.models import PointClassifier, create_model
from qs3.models.classifier import evaluating
from qs3.reading import naming
from qs3.runs.bundled import find_run, not_a_run
from qs3.runs.checks import Clouds
from qs3.runs.device import autocast
from qs3.runs.loaded import Description, Loaded, read_measured
from qs3.runs.run import (
    FOREST,
    MODEL,
    SETTINGS,
    read_settings,
    without_heights,
    without_removed,
)
from qs3.runs.settings import Precision, TrainSettings
from qs3.runs.weights import FORMAT, build, load_tensors_into, read_tensors
from qs3.structure import structure
from qs3.training.prepared import Prepared, prepare_clouds, prepare_each


@dataclass(frozen=True, kw_only=True)
class LoadedModel(Loaded):
    """A network read from a run."""

    file: ClassVar[str] = MODEL
    model: PointClassifier
    """The trained network, in evaluation mode, on the CPU."""
    preparation: Preparation = PAPER

    @property
    def num_points(self) -> int | None:
        """Points per cloud; None if unknown."""
        return self.settings["train"].get("num_points")

    @property
    def size_preparation(self) -> Preparation:
        """The preparation, which says whether the size of a cloud counts."""
        return self.preparation

    def describe(self, clouds: Clouds) -> Description:
        """Return the network's output for clouds as read."""
        if self.num_points is None and len({len(cloud) for cloud in clouds}) > 1:
            outputs = [self.describe([cloud]) for cloud in clouds]
            return Description(*map(np.concatenate, zip(*outputs, strict=True)))
        count = self.num_points or max(map(len, clouds), default=1)
        return describe(self.model, prepare_each(clouds, count, self.preparation))


def load_model(run_dir: str | Path) -> LoadedModel:
    """Read the network of a run.

    Args:
        run_dir: Folder of the run, a bundled network, or a ``.safetensors`` file that `save_model`
            wrote. Without ``settings.json`` next to it, the settings hold what the file contains,
            under ``train``.
    """
    run_dir = find_run(run_dir)
    path = run_dir if run_dir.is_file() else run_dir / MODEL
    if path.name == FOREST or (run_dir / FOREST).is_file():
        raise InputError(f"{run_dir}: holds a forest, and this takes a network only")
    if not path.is_file():
        state = "the run is not finished" if (run_dir / SETTINGS).is_file() else not_a_run(run_dir)
        raise InputError(f"{run_dir}: no {MODEL} here; {state}")
    tensors, facts = read_tensors(path)
    try:
        if facts["format"] != FORMAT:
            raise InputError(f"{path}: format {facts['format']}, this version reads {FORMAT}")
        with naming(path):
            class_names = check_class_names(facts["class_names"])
        preparation = structure(without_heights(facts.get("preparation", {})), Preparation, path)
        architecture = facts["model"], len(class_names), dict(facts["model_settings"])
        head = facts.get("head") is True
        with torch.random.fork_rng(devices=[]):
            inside = "model." * (preparation.align + preparation.size_input + head)
            _check_shapes(*architecture, tensors, inside, path)
            model = build(*architecture, preparation, head)
    except (KeyError, TypeError) as error:
        raise InputError(f"{path}: does not say which network it holds ({error})") from error
    load_tensors_into(model, tensors, path)
    if (path.parent / SETTINGS).is_file():
        settings = read_settings(path.parent)
    else:
        kept = ("model", "model_settings", "num_points", "preparation")
        settings = {"train": without_removed({key: facts[key] for key in kept if key in facts})}
        structure(settings["train"], TrainSettings, path)  # refuses an invalid one
    measured = read_measured(facts, path)
    measured |= {"class_names": class_names, "settings": settings, "preparation": preparation}
    return LoadedModel(model=model.eval(), **measured)


def _check_shapes(
    name: str,
    classes: int,
    arguments: Mapping[str, Any],
    tensors: Mapping[str, Tensor],
    inside: str,
    where: Path,
) -> None:
    """Refuse weights that do not fit the network inside the wrappers, before it takes memory."""
    try:
        with torch.device("meta"):
            wanted = create_model(name, classes, **arguments).state_dict()
    except (RuntimeError, OverflowError) as error:  # sizes beyond any number
        raise InputError(f"{where}: weights are of another network ({error})") from error
    for key, tensor in ((inside + key, tensor) for key, tensor in wanted.items()):
        held = tensors.get(key)
        if held is None and key == f"{inside}perspective":  # SimpleView's, up to version 0.2
            continue
        if held is None or held.shape != tensor.shape:
            size = "is missing" if held is None else f"is {list(held.shape)}"
            raise InputError(
                f"{where}: weights are of another network ({key} {size}, the settings of "
                f"{name} want {list(tensor.shape)})"
            )


def predict_probabilities(
    model: PointClassifier | LoadedModel,
    points: Float[np.ndarray, "b n 3"],
    *,
    num_points: int | None = None,
    preparation: Preparation | None = None,
    batch_size: int = 32,
) -> Float[np.ndarray, "b k"]:
    """Predict the class probabilities of clouds, without augmentation.

    Args:
        model: The network, or the result of `load_model`; its mode and device stay.
        points: Clouds as read.
        num_points: Points per cloud; None takes the loaded network's, or all.
        preparation: Preparation; None takes the loaded network's, or the unit ball.
        batch_size: Clouds in a forward pass.

    Returns:
        Softmax in float64; rows sum to 1 to rounding.

    Example:
        >>> from qs3.models import create_model
        >>> points = np.random.default_rng(0).normal(size=(3, 40, 3))
        >>> predict_probabilities(create_model("pointnet", 4), points, num_points=16).shape
        (3, 4)
    """
    if isinstance(model, LoadedModel):
        num_points, preparation = num_points or model.num_points, preparation or model.preparation
        model = model.model
    clouds = UnlabelledClouds(points, tuple(map(str, range(len(points)))))
    prepared = prepare_clouds(clouds, num_points or points.shape[1], preparation or PAPER)
    return describe(model, prepared, batch_size=batch_size).probabilities


@torch.no_grad()
def describe(
    model: PointClassifier,
    points: Prepared | Float[np.ndarray, "b m 3"],
    *,
    batch_size: int = 32,
    precision: Precision = "32-true",
) -> Description:
    """Return probabilities, pooled features and logits of prepared clouds, not augmented."""
    parameter = next(model.parameters())
    answers: list[tuple[np.ndarray, ...]] = []
    with evaluating(model):
        # If there is no cloud, a single point gives the widths.
        none = np.zeros((1, 1, 3), np.float32)
        for start in range(0, max(1, len(points)), batch_size):
            batch = torch.from_numpy(points[start : start + batch_size] if len(points) else none)
            with autocast(parameter.device, precision):
                encoded = model.encode(batch.to(parameter.device, parameter.dtype))
                logits = model.head(encoded)
            logits = logits.double()
            parts = torch.softmax(logits, dim=1), encoded.pooled.double(), logits
            answers.append(tuple(part.cpu().numpy()[: len(points)] for part in parts))
    description = Description(*map(np.concatenate, zip(*answers, strict=True)))
    if not all(np.isfinite(part).all() for part in description):
        raise InputError("answers of the network are not finite; its weights are damaged")
    return description
