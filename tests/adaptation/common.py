"""Small networks and clouds for the tests of methods."""

import dann  # noqa: F401  # so that create_method knows dann:DANN
import torch

from qs3.adaptation import Batch
from qs3.models import PointClassifier, create_model

from ..models.common import SMALL


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def make_model(name: str = "pointnet") -> PointClassifier:
    """A network of three classes, always with the same weights."""
    torch.manual_seed(0)
    return create_model(name, 3, **SMALL[name])


def make_batch(b: int = 4, n: int = 60) -> Batch:
    return Batch(torch.rand(b, n, 3, generator=seeded(1)) * 2 - 1, torch.arange(b) % 3)


def make_target(b: int = 3, n: int = 50) -> torch.Tensor:
    return torch.rand(b, n, 3, generator=seeded(2)) * 2 - 1


def ball(b: int = 4, n: int = 300, seed: int = 0) -> torch.Tensor:
    """Clouds in the unit ball, the farthest point of each on its surface."""
    points = torch.randn(b, n, 3, generator=seeded(seed))
    return points / points.norm(dim=2).amax(dim=1)[:, None, None]
