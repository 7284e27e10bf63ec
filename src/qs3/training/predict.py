"""Class probabilities of clouds."""

import numpy as np
import torch
from jaxtyping import Float

from qs3.errors import InputError
from qs3.io.clouds import UnlabelledClouds, numbered
from qs3.io.preparation import PAPER, Preparation
from qs3.models import PointClassifier
from qs3.models.classifier import evaluating
from qs3.training.checkpoint import LoadedModel
from qs3.training.checks import require_finite, require_size
from qs3.training.config import Precision
from qs3.training.device import autocast
from qs3.training.prepared import Prepared, prepare_clouds
from qs3.training.trained import Description


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
        model: The network, or the result of `qs3.training.load_model`; its mode and device stay.
        points: Clouds as read.
        num_points: Points a cloud; None takes the loaded network's, or all.
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
    prepared = _prepared(points, num_points, preparation)
    return describe(model, prepared, batch_size=batch_size).probabilities


def ask(loaded: LoadedModel, points: Float[np.ndarray, "b n 3"]) -> Description:
    """Return the network's description of clouds as read."""
    require_finite(points, numbered(len(points)))
    require_size(points, loaded.preparation, loaded.sizes)
    return describe(loaded.model, _prepared(points, loaded.num_points, loaded.preparation))


def _prepared(
    points: Float[np.ndarray, "b n 3"], num_points: int | None, preparation: Preparation | None
) -> Prepared[UnlabelledClouds]:
    clouds = UnlabelledClouds(points, numbered(len(points)))
    require_finite(points, [str(row) for row in range(len(points))])
    return prepare_clouds(clouds, num_points or points.shape[1], preparation or PAPER)


@torch.no_grad()
def describe(
    model: PointClassifier,
    points: Float[np.ndarray, "b n 3"] | Prepared,
    *,
    batch_size: int = 32,
    precision: Precision = "32-true",
) -> Description:
    """Return probabilities, pooled features and logits of prepared clouds, not augmented."""
    parameter = next(model.parameters())
    answers: list[np.ndarray] = []
    with evaluating(model):
        # A single point gives the widths, if there is no cloud.
        example = torch.zeros(1, 1, 3).to(parameter)
        encoded = model.encode(example)
        classes, width = model.head(encoded).shape[1], encoded.pooled.shape[1]
        for start in range(0, len(points), batch_size):
            batch = torch.from_numpy(points[start : start + batch_size])
            with autocast(parameter.device, precision):
                encoded = model.encode(batch.to(parameter.device, parameter.dtype))
                logits = model.head(encoded)
            logits = logits.double()
            parts = (torch.softmax(logits, dim=1), encoded.pooled.double(), logits)
            answers.append(torch.cat(parts, dim=1).cpu().numpy())
    rows = np.concatenate([np.zeros((0, 2 * classes + width)), *answers])
    if not np.isfinite(rows).all():
        raise InputError("answers of the network are not finite; its weights are damaged")
    return Description(*np.split(rows, [classes, classes + width], axis=1))
