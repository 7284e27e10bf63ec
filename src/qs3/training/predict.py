"""Class probabilities of clouds."""

from contextlib import nullcontext

import numpy as np
import torch
from jaxtyping import Float
from lightning_fabric import Fabric

from qs3.models import PointClassifier
from qs3.training.batches import prepare


@torch.no_grad()
def predict_probabilities(
    model: PointClassifier,
    points: Float[np.ndarray, "b n 3"],
    *,
    num_points: int | None = None,
    batch_size: int = 32,
    fabric: Fabric | None = None,
) -> Float[np.ndarray, "b k"]:
    """Predict the class probabilities of clouds, without augmentation.

    Args:
        model: The network; its mode is put back afterwards, its device stays.
        points: Clouds as read; they are brought to the unit ball here.
        num_points: Points a cloud, by farthest point sampling; None takes all.
        batch_size: Clouds in a forward pass. It does not change the result but for rounding.
        fabric: Number format; single precision where it is not given.

    Returns:
        Softmax in float64; rows sum to 1 to rounding.

    Example:
        >>> from qs3.models import create_model
        >>> points = np.random.default_rng(0).normal(size=(3, 40, 3))
        >>> predict_probabilities(create_model("pointnet", 4), points, num_points=16).shape
        (3, 4)
    """
    prepared = prepare(points, points.shape[1] if num_points is None else num_points)
    parameter = next(model.parameters())
    context = nullcontext if fabric is None else fabric.autocast
    training = model.training
    model.eval()
    rows = []
    try:
        for start in range(0, len(prepared), batch_size):
            batch = torch.from_numpy(prepared[start : start + batch_size])
            with context():
                logits = model(batch.to(parameter.device, parameter.dtype))
            rows.append(torch.softmax(logits.double(), dim=1).cpu().numpy())
    finally:
        model.train(training)
    return np.concatenate(rows) if rows else np.zeros((0, _classes(model)))


def _classes(model: PointClassifier) -> int:
    example = torch.zeros(1, 1, 3).to(next(model.parameters()))
    training = model.training
    model.eval()
    count = model(example).shape[1]
    model.train(training)
    return count
