"""Numbers that are said to be published, written down from the papers' releases."""

import dataclasses
import inspect

import pytest
import torch
from torch import nn

from qs3.adaptation import create_method, method_class
from qs3.models import create_model
from qs3.paper.rivals import curvature, deformations, gast
from qs3.runs.settings import PRESETS, TrainSettings

from ..adaptation.common import ball, make_batch, make_model, make_target, seeded

_HEAD = {"hidden": (512, 256), "dropout": 0.5}
NETWORKS = {
    # WangYueFt/dgcnn, pytorch/model.py; QS³, Models_Norm.py, has the same numbers.
    "dgcnn": _HEAD
    | {"neighbours": 20, "channels": (64, 64, 128, 256), "embedding": 1024, "variant": "official"},
    # charlesq34/pointnet, models/pointnet_cls.py: what dropout keeps is 0.7.
    "pointnet": {
        "channels": (64, 64, 64, 128, 1024), "hidden": (512, 256), "dropout": 0.3,
        "transforms": True,
    },
    # charlesq34/pointnet2, models/pointnet2_cls_ssg.py.
    "pointnet2": _HEAD | {
        "centres": (512, 128), "scales": ((0.2, 32, (64, 64, 128)), (0.4, 64, (128, 128, 256))),
        "embedding": (256, 512, 1024), "local": False,
    },
    # canqin001/PointDAN, Model.py and model_utils.py.
    "pointnet-sa": {
        "channels": (64, 64, 128, 1024), "transform_hidden": (512, 256), "nodes": 64,
        "neighbours": 64, "radius": 0.3, "node_width": 64, "hidden": (), "dropout": 0.0,
    },
    # Yochengliu/Relation-Shape-CNN, models/rscnn_ssn_cls.py.
    "rscnn": _HEAD | {
        "centres": (512, 128), "radii": (0.23, 0.32), "neighbours": (48, 64),
        "channels": (128, 512), "embedding": 1024,
    },
    # princeton-vl/SimpleView, configs.py and models/mv_utils.py.
    "simpleview": {
        "width": 16, "resolution": 128, "dropout": 0.5, "projection": "perspective",
    },
}  # fmt: skip
DROPPED = {"dgcnn": [0.5] * 2, "pointnet": [0.3] * 2, "pointnet2": [0.5] * 2, "pointnet-sa": [],
           "rscnn": [0.5] * 2, "simpleview": [0.5] * 2}  # fmt: skip
# DefRec_and_PCM, PointDA/scripts and trainer.py.
_DEFREC = {"weight": 0.2, "on_source": False, "dropout": 0.5}
METHODS = {
    "defrec": _DEFREC,
    "pcm": {"concentration": 1.0},
    "defrec-pcm": _DEFREC | {"concentration": 1.0},
    # zou-longkun/GAST, train_Norm.py.
    "gast": {
        "classification_weight": 0.5, "location_weight": 0.5, "rotation_weight": 0.2,
        "concentration": 1.0,
    },
    # canqin001/PointDAN, train.py, Model.py and model_utils.py.
    "pointdan": {
        "source_weight": 1.0, "discrepancy_weight": 1.0, "node_weight": 1.0,
        "bandwidths": (0.01, 0.1, 1.0, 10.0, 100.0), "nodes": 64, "neighbours": 64, "radius": 0.3,
        "node_width": 64, "reduction": 8, "classifier_rate": 2.0,
    },
}  # fmt: skip


@pytest.mark.parametrize("name", NETWORKS)
def test_defaults_of_networks(name):
    model = create_model(name, 10)
    arguments = inspect.signature(type(model)).parameters.values()
    assert {one.name: one.default for one in arguments if one.name != "num_classes"} == NETWORKS[
        name
    ]
    dropped = [layer.p for layer in model.modules() if isinstance(layer, nn.Dropout)]
    assert [p for p in dropped if p] == DROPPED[name]  # the T-Nets drop nothing


@pytest.mark.parametrize("name", METHODS)
def test_defaults_of_methods(name):
    fields = {one.name: one.default for one in dataclasses.fields(method_class(name))}
    assert fields | METHODS[name] == fields
    assert fields.keys() == {"model", "label_smoothing", *METHODS[name]}
    assert fields["label_smoothing"] == 0.0


def test_points_that_a_deformed_cell_has(monkeypatch):
    """40 in DefRec.py of DefRec_and_PCM, 20 in utils/pc_utils.py of GAST."""
    asked = []
    real = deformations.pick_cells
    for module in (deformations, gast):
        monkeypatch.setattr(
            module, "pick_cells", lambda *args: asked.append(args[1]) or real(*args)
        )
    deformations.deform_voxels(ball(), seeded())
    create_method("gast", make_model())(make_batch(), make_target(), 0.0, seeded())
    assert asked == [40, 20, 20]


def test_curvature_is_of_32_points():
    """data/compute_norm_curv.py of GAST."""
    points = ball(1, 200)
    assert torch.equal(curvature.curvature(points), curvature.curvature(points, 32))
    assert not torch.equal(curvature.curvature(points), curvature.curvature(points, 31))


def test_defaults_of_trainings():
    """QS³: train_sim2real.py, train_QBST_sim2real.py and data/dataloader_sim2real.py."""
    settings = TrainSettings()
    assert (settings.epochs, settings.batch_size, settings.num_points) == (200, 32, 1024)
    assert (settings.learning_rate, settings.weight_decay) == (1e-3, 5e-5)
    assert (settings.jitter_sigma, settings.jitter_clip) == (0.01, 0.02)
    assert settings.rotate_z
    for name, step in (("paper", 0.0), ("released", 0.0), ("spst", 0.005)):  # SPST: train_SPST.py
        rounds = PRESETS[name]
        assert (rounds.threshold, rounds.step, rounds.weight_step) == (0.8, 0.005, step)
        assert (rounds.rounds, rounds.epochs) == (10, 10)
