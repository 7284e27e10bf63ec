"""Training on pseudo labels of the target, with or without the source beside them."""

from dataclasses import dataclass

import torch
from torch import Generator, Tensor

from qs3.adaptation.method import Batch, Method, Target, Terms, cross_entropy


@dataclass(eq=False, repr=False, kw_only=True)
class PseudoLabelled(Method):
    """Cross entropy on pseudo-labelled clouds of the target, plus that on the source.

    The first part of each batch is of the target, the second, if any, of the source. Each passes
    through the network separately, the source first.
    """

    weight_step: float = 0.0
    """Taken off the factors of both losses after each epoch; they begin at 1 (SPST: 0.005)."""
    epochs: range = range(1)
    """Numbers of the epochs of this training, for ``weight_step``."""

    def losses(self, source: Batch, target: Target, progress: float, generator: Generator) -> Terms:
        """Return the weighted cross entropies, ``pseudo`` and ``source``."""
        count = source.parts[0] if source.parts else len(source.labels)
        done = min(int(progress * len(self.epochs) + 1e-9), len(self.epochs) - 1)
        weight = 1.0 - self.weight_step * self.epochs[done]
        terms: dict[str, Tensor] = {}
        right = torch.zeros((), dtype=torch.int64, device=source.labels.device)
        passes: tuple[tuple[str, slice], ...] = (
            ("source", slice(count, None)),
            ("pseudo", slice(0, count)),
        )
        for name, rows in passes:
            labels = source.labels[rows]
            if not len(labels):
                continue
            logits = self.model(source.points[rows])
            right += (logits.detach().argmax(dim=1) == labels).sum()
            terms[name] = weight * cross_entropy(logits, labels, self.label_smoothing)
        self.right = right
        return terms
