"""What a method of adaptation offers to the training loop."""

from abc import ABC, abstractmethod
from collections.abc import Iterable
from typing import NamedTuple

import torch
from jaxtyping import Float, Int
from torch import Tensor, nn

from qs3.models import PointClassifier


class Batch(NamedTuple):
    """Labelled clouds on the training device."""

    points: Float[Tensor, "b n 3"]
    """Augmented clouds."""
    labels: Int[Tensor, "b"]
    """Their classes, or pseudo labels."""


class Method(nn.Module, ABC):
    """A way to train a network on a labelled source and, maybe, an unlabelled target.

    A method owns the network and whatever else it trains (heads, discriminators). It never sees a
    label of the target.

    Args:
        model: The network to train.
    """

    uses_target: bool = False
    """Whether `losses` needs a batch of the target."""

    def __init__(self, model: PointClassifier) -> None:
        super().__init__()
        self.model = model

    @abstractmethod
    def losses(
        self,
        source: Batch,
        target: Float[Tensor, "b_t n_t 3"] | None,
        progress: float,
        generator: torch.Generator,
    ) -> dict[str, Tensor]:
        """Return named scalar losses; their sum is minimised, each is logged.

        Args:
            source: Labelled clouds.
            target: Clouds of the target; None where `uses_target` is false.
            progress: Share of the training that is done, 0 to 1.
            generator: Source of every random draw of the method (on the CPU).
        """

    def forward(
        self,
        source: Batch,
        target: Float[Tensor, "b_t n_t 3"] | None,
        progress: float,
        generator: torch.Generator,
    ) -> dict[str, Tensor]:
        """Return `losses`; a distributed wrapper needs the call to pass through here."""
        return self.losses(source, target, progress, generator)

    def parameter_groups(self, learning_rate: float) -> Iterable[dict]:
        """Return the optimiser's parameter groups: by default one with every parameter."""
        return [{"params": [p for p in self.parameters() if p.requires_grad], "lr": learning_rate}]

    def after_step(self) -> None:
        """Run after each optimiser step; by default nothing."""
        return
