"""Deformation reconstruction, DefRec (Achituve et al., WACV 2021)."""

from typing import cast, get_args

import torch
from jaxtyping import Bool, Float
from torch import Tensor, nn

from qs3.adaptation.chamfer import chamfer
from qs3.adaptation.deformations import DEFORMATIONS, Deformation, Deformed, deform_features
from qs3.adaptation.method import Batch, Domain, Method
from qs3.adaptation.normalisation import DomainNorm
from qs3.errors import InputError
from qs3.models import Features, PointClassifier, feature_widths
from qs3.models.checks import check_flag, check_number
from qs3.models.ops import gather_points

_SCALE = 20.0
"""Factor of the released code, which brings the distance to the size of a cross entropy."""


def reconstruction_loss(
    predicted: Float[Tensor, "b n 3"],
    original: Float[Tensor, "b n 3"],
    moved: Bool[Tensor, "b n"],
) -> Float[Tensor, ""]:
    """20 times the Chamfer distance over the moved points, mean over the clouds.

    Example:
        >>> cloud, moved = torch.zeros(1, 4, 3), torch.tensor([[True, False, False, True]])
        >>> float(reconstruction_loss(cloud + 0.5, cloud, moved))
        30.0
    """
    return _SCALE * chamfer(predicted, original, moved, moved).mean()


class ReconstructionHead(nn.Module):
    """Layers of 256, 256 and 128 channels and three coordinates, at each moved point.

    Their input is the point's local feature and its cloud's pooled one. The pooled part of the
    first product is made once a cloud, so that the two are never joined. Batch normalisation
    counts the moved points of the whole batch.

    Args:
        local: Channels of the local features.
        pooled: Channels of the pooled feature.
        dropout: Probability of dropping a hidden unit.
    """

    def __init__(self, local: int, pooled: int, dropout: float) -> None:
        super().__init__()
        self.local = nn.Linear(local, 256, bias=False)
        self.pooled = nn.Linear(pooled, 256, bias=False)
        layers: list[nn.Module] = [*_finish(256, dropout)]
        for width, following in ((256, 256), (256, 128)):
            layers += [nn.Linear(width, following, bias=False), *_finish(following, dropout)]
        # The released network drops nothing right before the coordinates.
        self.layers = nn.Sequential(*layers[:-1], nn.Linear(128, 3))

    def forward(self, features: Features, moved: Bool[Tensor, "b n"]) -> Float[Tensor, "b n 3"]:
        """Return where moved points were; 0 for all others."""
        local = features.local
        assert local is not None  # noqa: S101
        b, n, e = local.shape
        row = moved.flatten().nonzero()[:, 0]
        of_points = gather_points(local.reshape(1, b * n, e), row[None])
        of_clouds = gather_points(self.pooled(features.pooled)[None], row[None] // n)
        found = self.layers((self.local(of_points) + of_clouds)[0])
        nowhere = torch.zeros((b * n, 3), dtype=found.dtype, device=found.device)
        return nowhere.index_put((row,), found).view(b, n, 3)


def _finish(width: int, dropout: float) -> tuple[nn.Module, ...]:
    return nn.BatchNorm1d(width), nn.ReLU(inplace=True), nn.Dropout(dropout)


class Reconstruction(nn.Module):
    """DefRec's task: deform clouds, pass them through a method's network, rebuild what moved.

    Args:
        model: The network whose features the head will read.
        deformation: Which parts move, and where to.
        weight: Factor of the loss.
        on_source: Whether source clouds are deformed as well as target clouds.
        dropout: Probability of dropping a hidden unit of the head.

    Raises:
        InputError: where a setting is not usable.
    """

    def __init__(
        self,
        model: PointClassifier,
        deformation: str,
        weight: float,
        on_source: bool,
        dropout: float,
    ) -> None:
        super().__init__()
        if deformation not in get_args(Deformation):
            raise InputError(
                f"unknown deformation {deformation!r}; choose one of "
                f"{', '.join(get_args(Deformation))}"
            )
        check_number("weight", weight, 0.0, 1.0)
        check_flag("on_source", on_source)
        check_number("dropout", dropout, 0.0, 1.0)
        self.deformation = deformation
        self.weight = weight
        self.on_source = on_source
        widths = feature_widths(model)
        self.head = ReconstructionHead(cast(int, widths.local), widths.pooled, dropout)

    def losses(
        self,
        method: Method,
        source: Float[Tensor, "b n 3"],
        target: Float[Tensor, "b_t n_t 3"],
        generator: torch.Generator,
    ) -> dict[str, Tensor]:
        """Return the weighted loss of each domain that is deformed."""
        terms = {}
        if self.on_source:
            terms["defrec_source"] = self._loss(method, source, "source", generator)
        terms["defrec_target"] = self._loss(method, target, "target", generator)
        return terms

    def _loss(
        self, method: Method, points: Tensor, domain: Domain, generator: torch.Generator
    ) -> Tensor:
        deformed = self.deform(method, points, domain, generator)
        predicted = self.head(method.features(deformed.points, domain), deformed.moved)
        return self.weight * reconstruction_loss(predicted, points, deformed.moved)

    def deform(
        self,
        method: Method,
        points: Float[Tensor, "b n 3"],
        domain: Domain,
        generator: torch.Generator,
    ) -> Deformed:
        """Return deformed clouds of a domain."""
        if self.deformation != "features":
            return DEFORMATIONS[self.deformation](points, generator)
        # In evaluation mode, so that this look leaves no trace in the running statistics.
        training = method.model.training
        method.model.eval()
        try:
            with torch.no_grad():
                local = method.features(points, domain).local
        finally:
            method.model.train(training)
        assert local is not None  # noqa: S101
        return deform_features(points, local, generator)


class DefRec(Method):
    """Classify the source; rebuild deformed parts of target clouds, and of source clouds if asked.

    L = (1 − w) · CE(source) + w · 20 · Chamfer(rebuilt part, original part).

    NOTE: only the volume-based deformations follow released code. There the cell is the first in a
    random order *of the batch* with 40 points, and a cloud without one has no finite loss; here
    each cloud has an order of its own, and the fullest cell stands in for a missing one.
    NOTE: the paper gives no full account of the others. *features*: the 15 % of points most alike
    a random one collapse to it; likeness is the distance of the network's own local features of the
    whole cloud, found in evaluation mode without a gradient. *split*, *gradient* and *lambertian*
    (after Hermosilla et al., TOG 2018): points that the uneven sampling drops land beside ones that
    survive, so that clouds keep their size, and the dropped ones are rebuilt. The shares and
    probabilities of `qs3.adaptation.deformations` are ours.
    NOTE: the head is evaluated at the moved points alone, whose batch statistics it then uses; the
    released one is evaluated at all points, and masked.
    NOTE: the weight is that of the released scripts; the default of their parser is 0.5.

    Args:
        model: The network to train; it must give local features.
        deformation: Which parts move, and where to: see `qs3.adaptation.deformations`.
        weight: w.
        on_source: Whether source clouds are deformed and rebuilt as well.
        dropout: Probability of dropping a hidden unit of the reconstruction head.
        label_smoothing: ε of `qs3.adaptation.method.cross_entropy`.
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
        label_smoothing: float = 0.0,
        norm: DomainNorm | None = None,
    ) -> None:
        super().__init__(model, label_smoothing=label_smoothing, norm=norm)
        self.rebuild = Reconstruction(model, deformation, weight, on_source, dropout)

    def losses(
        self,
        source: Batch,
        target: Float[Tensor, "b_t n_t 3"] | None,
        progress: float,
        generator: torch.Generator,
    ) -> dict[str, Tensor]:
        """Return the cross entropy of the source and the distance of rebuilt parts."""
        assert target is not None  # noqa: S101
        cross_entropy = self.classification(self.logits(source.points, "source"), source)
        rebuilt = self.rebuild.losses(self, source.points, target, generator)
        return {"source": (1 - self.rebuild.weight) * cross_entropy, **rebuilt}
