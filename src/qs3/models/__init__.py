"""Networks that classify point clouds; PyTorch loads when one of these names is first used."""

from typing import TYPE_CHECKING

from qs3.lazy import loader

if TYPE_CHECKING:
    from qs3.models.classifier import Features as Features
    from qs3.models.classifier import PointClassifier as PointClassifier
    from qs3.models.classifier import describe_point as describe_point
    from qs3.models.classifier import feature_widths as feature_widths
    from qs3.models.dgcnn import DGCNN as DGCNN
    from qs3.models.factory import create_model as create_model
    from qs3.models.factory import list_models as list_models
    from qs3.models.pointnet import PointNet as PointNet
    from qs3.models.pointnet2 import PointNet2 as PointNet2

__getattr__ = loader(__name__)
