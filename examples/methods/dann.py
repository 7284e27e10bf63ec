"""DANN (Ganin & Lempitsky, ICML 2015; JMLR 2016): a method of adaptation outside of qs3.

In this folder: qs3 train --source S --target T --method dann:DANN --out RUN
"""

import itertools
import math
from dataclasses import dataclass

from jaxtyping import Float
from torch import Generator, Tensor, nn

from qs3.adaptation.method import Batch, Method, Target, Terms
from qs3.checks import NotNegative, Positive, check_numbers
from qs3.models import feature_widths
from qs3.paper.rivals.reversal import reverse_gradient


def reversal_coefficient(progress: float, gamma: float = 10.0) -> float:
    """Return λ = 2 / (1 + exp(−γ p)) − 1, from 0 to nearly 1 over the training (§5.2.2).

    Example:
        >>> [round(reversal_coefficient(p), 3) for p in (0.0, 0.1, 0.5, 1.0)]
        [0.0, 0.462, 0.987, 1.0]
    """
    return 2 / (1 + math.exp(-gamma * progress)) - 1


def domain_loss(source: Float[Tensor, "b"], target: Float[Tensor, "b_t"]) -> Float[Tensor, ""]:
    """Logistic loss of a domain discriminator, mean over each domain, summed (JMLR 2016, eq. 9).

    It should make its scores of the source negative and those of the target positive.

    Example:
        >>> import torch
        >>> round(float(domain_loss(torch.zeros(3), torch.zeros(2))), 4)  # 2 log 2
        1.3863
    """
    softplus = nn.functional.softplus
    return softplus(source.float()).mean() + softplus(-target.float()).mean()


@dataclass(eq=False, repr=False, kw_only=True)
class DANN(Method):
    """Domain-adversarial training on the pooled features, through gradient reversal.

    A discriminator learns to predict the domain from the pooled feature; through gradient reversal
    the network learns the opposite (`reversal_coefficient`).

    NOTE: the authors published no network for point clouds. The discriminator is their largest (x →
    1024 → 1024 → 1); their schedule of rate and momentum and their dropout are not used.
    """

    uses_target = True

    hidden: tuple[int, ...] = (1024, 1024)
    """Widths of the discriminator's hidden layers."""
    gamma: Positive = 10.0
    """γ of `reversal_coefficient`."""
    domain_weight: NotNegative = 1.0
    """Factor of the domain loss."""

    def __post_init__(self) -> None:
        super().__post_init__()
        check_numbers("hidden", (1, *self.hidden))
        layers: list[nn.Module] = []
        widths = (feature_widths(self.model).pooled, *self.hidden)
        for c, d in itertools.pairwise(widths):
            layers += [nn.Linear(c, d), nn.ReLU()]
        self.discriminator = nn.Sequential(*layers, nn.Linear(widths[-1], 1))

    def losses(self, source: Batch, target: Target, progress: float, generator: Generator) -> Terms:
        """Return the cross entropy of the source and the domain loss of both."""
        of_source, of_target = self.both(source, target)
        coefficient = reversal_coefficient(progress, self.gamma)
        scores = [
            self.discriminator(reverse_gradient(features.pooled, coefficient))[:, 0]
            for features in (of_source, of_target)
        ]
        return {
            "source": self.classification(self.model.head(of_source), source),
            "domain": self.domain_weight * domain_loss(*scores),
        }
