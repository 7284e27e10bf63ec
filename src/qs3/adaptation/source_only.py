"""Training on labelled clouds alone: the row without adaptation, and the *Supervised* row."""

import torch
from jaxtyping import Float
from torch import Tensor

from qs3.adaptation.method import Batch, Method


class SourceOnly(Method):
    """Cross entropy on the source.

    With the target's labelled training part as its source it is the paper's *Supervised*.
    """

    def losses(
        self,
        source: Batch,
        target: Float[Tensor, "b_t n_t 3"] | None,
        progress: float,
        generator: torch.Generator,
    ) -> dict[str, Tensor]:
        """Return the cross entropy of the source batch."""
        return {"source": self.classification(self.logits(source.points), source)}
