"""How the learning rate falls, as functions of what has been: nothing to keep over a stop."""

import math
from collections.abc import Sequence


def cosine(epoch: int, period: int) -> float:
    """Factor of the learning rate: from 1 in epoch 0 to 0 in epoch ``period``, and up again.

    Example:
        >>> [round(cosine(epoch, 2), 3) for epoch in range(5)]
        [1.0, 0.5, 0.0, 0.5, 1.0]
    """
    return 0.5 * (1.0 + math.cos(math.pi * epoch / period))


def plateau(
    losses: Sequence[float],
    rate: float,
    *,
    patience: int = 10,
    factor: float = 0.5,
    floor: float = 1e-5,
    threshold: float = 1e-4,
) -> float:
    """Factor of the learning rate after some epochs: smaller each time that the loss stalls.

    The rate is multiplied by ``factor`` once more than ``patience`` epochs in a row have not
    undercut the least loss so far by a share of ``threshold`` (the rule of PyTorch's
    ``ReduceLROnPlateau``). The values are those of SimpleView's protocol (Goyal et al., ICML 2021);
    the loss is that of the training, so that no test set is looked at.

    Args:
        losses: Mean loss of each epoch so far.
        rate: Learning rate at the start.
        patience: Epochs without progress that are borne.
        factor: What the rate is multiplied by.
        floor: Least learning rate.
        threshold: Share by which a loss must undercut the least one to be progress.

    Example:
        >>> plateau([1.0] * 12, 1e-3), plateau([1.0] * 11, 1e-3)
        (0.5, 1.0)
    """
    best, stalled, now = math.inf, 0, rate
    for loss in losses:
        if loss < best * (1.0 - threshold):
            best, stalled = loss, 0
        else:
            stalled += 1
        if stalled > patience:
            now, stalled = min(now, max(now * factor, floor)), 0
    return now / rate
