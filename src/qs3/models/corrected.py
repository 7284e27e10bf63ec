"""Any network, frozen, with a linear correction of its logits."""

from jaxtyping import Float
from torch import Tensor, nn

from qs3.models.classifier import Features, PointClassifier, describe_point


class Corrected(PointClassifier):
    """Any network, with a linear map of its pooled feature added to its logits.

    The map begins at zero, so that the network begins as it is.

    Convention:
        Points are those of the network inside.

    Example:
        >>> import torch
        >>> from qs3.models import create_model
        >>> network = create_model("pointnet", 10).eval()
        >>> points = torch.rand(2, 32, 3)
        >>> torch.equal(Corrected(network, 10).eval()(points), network(points))
        True
    """

    def __init__(self, model: PointClassifier, num_classes: int) -> None:
        super().__init__()
        self.model = model
        self.correction = nn.Linear(describe_point(model).pooled.shape[1], num_classes)
        nn.init.zeros_(self.correction.weight)
        nn.init.zeros_(self.correction.bias)

    def encode(self, points: Float[Tensor, "b n 3"]) -> Features:
        """Describe each cloud."""
        return self.model.encode(points)

    def head(self, features: Features) -> Float[Tensor, "b k"]:
        """Return the corrected logits of the network inside."""
        return self.model.head(features) + self.correction(features.pooled)
