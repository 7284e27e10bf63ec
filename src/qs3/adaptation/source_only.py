"""Training on labelled clouds alone: the row without adaptation, and the *Supervised* row."""

import torch
from jaxtyping import Float
from torch import Tensor

from qs3.adaptation.losses import cross_entropy
from qs3.adaptation.method import Batch, Method
from qs3.models import PointClassifier


class SourceOnly(Method):
    """Cross entropy on the source.

    With the target's labelled training part as its source it is the paper's *Supervised*.

    Args:
        model: The network to train.
        label_smoothing: ε of `qs3.adaptation.losses.cross_entropy`.
    """

    def __init__(self, model: PointClassifier, label_smoothing: float = 0.0) -> None:
        super().__init__(model)
        self.label_smoothing = label_smoothing

    def losses(
        self,
        source: Batch,
        target: Float[Tensor, "b_t n_t 3"] | None,
        progress: float,
        generator: torch.Generator,
    ) -> dict[str, Tensor]:
        """Return the cross entropy of the source batch."""
        logits = self.model(source.points)
        return {"source": cross_entropy(logits, source.labels, self.label_smoothing)}
