"""Losses that methods share."""

import torch
from jaxtyping import Float, Int
from torch import Tensor


def cross_entropy(
    logits: Float[Tensor, "b k"], labels: Int[Tensor, "b"], label_smoothing: float = 0.0
) -> Float[Tensor, ""]:
    """Mean cross entropy, in single precision at least.

    Args:
        logits: Class scores.
        labels: True classes.
        label_smoothing: ε of Szegedy et al. (CVPR 2016, §7): the target is 1 − ε at the label plus
            ε/k everywhere.

    Example:
        >>> float(cross_entropy(torch.zeros(1, 4), torch.tensor([2])).exp())
        4.0
    """
    logits = logits.float() if logits.dtype in (torch.float16, torch.bfloat16) else logits
    return torch.nn.functional.cross_entropy(logits, labels, label_smoothing=label_smoothing)
