"""CORAL: both domains with one covariance (Deep CORAL: Sun & Saenko, ECCV 2016 workshops)."""

from typing import Literal, get_args

import torch
from jaxtyping import Float
from torch import Tensor

from qs3.adaptation.discrepancies import coral
from qs3.adaptation.method import Batch, Method
from qs3.adaptation.normalisation import DomainNorm
from qs3.models import PointClassifier
from qs3.models.checks import check_choice, check_number

Layer = Literal["logits", "pooled"]
"""What has its covariance matched: the scores, as published, or the head's input."""


class CORAL(Method):
    """Cross entropy on the source plus the distance of the domains' covariances.

    NOTE: the paper sets the weight so that both losses end about equal, and gives no number; here
    it is 1. Its last layer learns ten times as fast as the others, which came pretrained; here
    all are new and learn alike.

    Args:
        model: The network to train.
        coral_weight: Factor of the distance, λ of the paper (eq. 6).
        layer: Whose covariance is matched.
        label_smoothing: ε on the source.
        norm: How the network normalises the two domains.

    Raises:
        InputError: where a setting is unusable.
    """

    uses_target = True

    def __init__(
        self,
        model: PointClassifier,
        *,
        coral_weight: float = 1.0,
        layer: Layer = "logits",
        label_smoothing: float = 0.0,
        norm: DomainNorm | None = None,
    ) -> None:
        super().__init__(model, label_smoothing=label_smoothing, norm=norm)
        check_number("coral_weight", coral_weight, 0.0, 1e6)
        check_choice("layer", layer, *get_args(Layer))
        self.coral_weight, self.layer = coral_weight, layer

    def losses(
        self,
        source: Batch,
        target: Float[Tensor, "b_t n_t 3"] | None,
        progress: float,
        generator: torch.Generator,
    ) -> dict[str, Tensor]:
        """Return the cross entropy of the source and the distance of the covariances."""
        assert target is not None  # noqa: S101
        here = self.features(source.points, "source")
        there = self.features(target, "target")
        logits = self.head(here, "source")
        if self.layer == "logits":
            distance = coral(logits, self.head(there, "target"))
        else:
            distance = coral(here.pooled, there.pooled)
        return {
            "source": self.classification(logits, source),
            "coral": self.coral_weight * distance,
        }
