"""DefRec on the target with PCM on the source (Achituve et al., WACV 2021)."""

import torch
from jaxtyping import Float
from torch import Tensor

from qs3.adaptation.defrec import Reconstruction
from qs3.adaptation.method import Batch, Method
from qs3.adaptation.normalisation import DomainNorm
from qs3.adaptation.pcm import mixed_classification
from qs3.models import PointClassifier
from qs3.models.checks import check_number


class DefRecPCM(Method):
    """Classify mixed source clouds and rebuild deformed parts of target clouds.

    L = (1 − w) · PCM(source) + w · 20 · Chamfer(rebuilt part, original part).

    NOTE: all that `qs3.adaptation.defrec.DefRec` and `qs3.adaptation.pcm.PCM` note holds here too.

    Args:
        model: The network to train; it must give local features.
        deformation: As of `qs3.adaptation.defrec.DefRec`.
        weight: w.
        on_source: Whether source clouds are deformed and rebuilt as well.
        dropout: Probability of dropping a hidden unit of the reconstruction head.
        concentration: γ of λ ~ Beta(γ, γ); 1 is the paper's.
        label_smoothing: ε of `qs3.adaptation.losses.cross_entropy`.
        norm: How the network normalises the two domains.

    Raises:
        InputError: where a setting is not usable, or the network has no local features.
    """

    uses_target = True
    needs_local = True

    def __init__(
        self,
        model: PointClassifier,
        *,
        deformation: str = "voxels",
        weight: float = 0.2,
        on_source: bool = False,
        dropout: float = 0.5,
        concentration: float = 1.0,
        label_smoothing: float = 0.0,
        norm: DomainNorm | None = None,
    ) -> None:
        super().__init__(model, label_smoothing=label_smoothing, norm=norm)
        check_number("concentration", concentration)
        self.concentration = concentration
        self.rebuild = Reconstruction(model, deformation, weight, on_source, dropout)

    def losses(
        self,
        source: Batch,
        target: Float[Tensor, "b_t n_t 3"] | None,
        progress: float,
        generator: torch.Generator,
    ) -> dict[str, Tensor]:
        """Return the cross entropy of mixed source clouds and the distance of rebuilt parts."""
        assert target is not None  # noqa: S101
        mixed = mixed_classification(self, source, generator, self.concentration)
        rebuilt = self.rebuild.losses(self, source.points, target, generator)
        return {"pcm": (1 - self.rebuild.weight) * mixed, **rebuilt}
