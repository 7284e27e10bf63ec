"""How large the tables are made: meshes, scans, points and steps of each scale."""

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from qs3.clouds.preparation import ROBUST
from qs3.meshes.classes import POINTDA10
from qs3.paper import ScaleName
from qs3.runs.settings import LIGHT, TrainSettings

NETWORKS = ("pointnet2", "dgcnn", "rscnn", "simpleview")
"""The paper's networks, in the order of its table."""
VARIANTS: Mapping[str, Mapping[str, Any]] = {
    "pointnet-sa": {},
    "simpleview-64": {"resolution": 64},
}
"""PointDAN's own network, and one that is too slow for processors at its usual size."""


@dataclass(frozen=True)
class Scale:
    """Size of a bench: its data and its trainings."""

    name: str
    source_per_class: int
    """Objects per class of the source, of which a tenth is held out."""
    target_per_class: int
    """Objects per class to adapt to."""
    test_per_class: int
    common: tuple[str, ...] = ("chair", "table")
    """Classes that are frequent in the target, as in scans of rooms."""
    common_factor: int = 3
    """Frequency of common classes over that of the others."""
    source_views: int = 5
    """Views fused into a scan of the source."""
    data_points: int = 2048
    """Points of each cloud on disk."""
    meshes: tuple[str, ...] = ("cad",)
    """Folders of artists' meshes in the shared folder."""
    source_scan: Mapping[str, Any] = field(default_factory=dict)
    """Settings of the source's scans that differ from those of `GenerateSettings`."""
    target_scan: Mapping[str, Any] = field(default_factory=dict)
    """Settings of D and F; empty is a D435 before a floor and a neighbour."""
    train: TrainSettings = field(default_factory=TrainSettings)
    """Settings of all trainings except their seed."""
    optimiser_steps: int | None = None
    """Approximate steps of each training, in place of a number of epochs."""
    more_steps: tuple[int, ...] = ()
    """Steps of further rows of `uda`, which train for as many as others do with their rounds."""
    rounds: Mapping[str, Any] = field(default_factory=dict)
    """Settings of self-training that differ from the row's preset."""
    networks: Mapping[str, Mapping[str, Any]] = field(
        default_factory=lambda: {name: {} for name in NETWORKS}
    )
    """Networks of the tables, each with the settings that differ from its defaults."""
    sources: tuple[str, ...] = ("M-D", "S-D", "M-F", "S-F")
    """Usual columns of the table of networks without adaptation."""
    ordinary: Mapping[str, Any] = field(default_factory=dict)
    """Settings of training that the tables of networks change."""
    fused_views: tuple[int, ...] = (1, 2, 3, 4, 5, 6, 7, 8)
    thetas: tuple[float, ...] = (0.5, 0.6, 0.7, 0.8, 0.9, 0.95)
    steps: tuple[float, ...] = (0.0, 0.005, 0.01, 0.02)
    sensors: tuple[str, ...] = ("paper", "d435", "kinect-v1")

    @property
    def smoke(self) -> bool:
        """Return whether the scale is too small to compare methods."""
        trained = self.source_per_class * (1 - self.train.holdout)
        return trained < 40 or self.train.num_points < 256 or any(self.networks.values())

    @property
    def has_other_steps(self) -> bool:
        """Return whether the number of steps is not that of the scale of this name."""
        usual = [scale.optimiser_steps for name, scale in SCALES.items() if name == self.name]
        return self.optimiser_steps not in (None, *usual)

    def target_count(self, class_name: str, per_class: int) -> int:
        """Return how many objects of a class a part of the target has."""
        return per_class * (self.common_factor if class_name in self.common else 1)

    def count_clouds(self, domain: str) -> int:
        """Return how many clouds a domain made here has to train on."""
        if domain in ("D", "F"):
            return sum(self.target_count(name, self.target_per_class) for name in POINTDA10)
        return self.source_per_class * len(POINTDA10) * (3 if domain == "S+C+M" else 1)


_NARROW: Mapping[str, Mapping[str, Any]] = {
    "pointnet2": {
        "centres": (96, 32),
        "scales": ((0.25, 16, (32, 32, 64)), (0.5, 16, (64, 64, 128))),
        "embedding": (128, 256),
    },
    "dgcnn": {"neighbours": 10, "channels": (32, 32, 64, 64), "embedding": 256},
    "rscnn": {
        "centres": (96, 32),
        "radii": (0.25, 0.5),
        "neighbours": (16, 16),
        "channels": (64, 128),
        "embedding": 256,
    },
    "simpleview": {"width": 8, "resolution": 32},
}
"""Networks for one core: a quarter of the width or less."""

_SIMPLEVIEW: Mapping[str, Any] = {
    "epochs": 1000,
    "batch_size": 32,
    "weight_decay": 1e-4,
    "label_smoothing": 0.2,
}
"""SimpleView's protocol of training, which the paper's main table follows, but for its learning
rate, which falls by plateaus of the loss there and by a cosine here."""

_SMOKE = Scale(
    name="smoke",
    source_per_class=8,
    target_per_class=4,
    test_per_class=3,
    source_views=2,
    data_points=512,
    train=TrainSettings(
        model="dgcnn",
        model_settings=_NARROW["dgcnn"],
        num_points=256,
        epochs=12,
        batch_size=16,
        learning_rate=2e-3,
        validate_every=4,
    ),
    # Networks of so few clouds are seldom sure.
    rounds={"threshold": 0.4, "rounds": 3, "epochs": 2},
    networks=_NARROW,
    fused_views=(1, 2, 4, 8),
    thetas=(0.3, 0.4, 0.5),
    steps=(0.0, 0.005, 0.02),
)

# Real sizes in metres on both sides, as the real objects have them. D is what a Kinect sees in
# rooms, as in NYU Depth v2; none of the source's cameras works as it does.
_LAPTOP = Scale(
    name="laptop",
    source_per_class=60,
    target_per_class=100,
    test_per_class=30,
    meshes=("cad", "cad_more"),
    source_scan={"sensor": "d435", "object_size": "class"},
    target_scan={
        "sensor": "kinect-v1",
        "randomise": ("rooms",),
        "crop": "mask",
        "least_pixels": 2500,  # as of NYU's strict objects
    },
    optimiser_steps=4000,
    train=TrainSettings(
        model="pointnet",
        model_settings={"transforms": False},
        num_points=256,
        batch_size=32,
        label_smoothing=0.1,
        validate_every=40,
        preparation=replace(ROBUST, size_input=True),
        augmentation=LIGHT,
    ),
    sources=("M-D", "S-D", "S+C+M-D", "M-R", "S-R", "S+C+M-R", "M-U", "S-U", "S+C+M-U"),
    fused_views=(1, 2, 3, 5, 8),
    sensors=("d415", "d435", "kinect-v1"),
)

SCALES: Mapping[ScaleName, Scale] = {
    # One seed of M-D and S-D takes about a quarter of an hour on one core.
    "smoke": _SMOKE,
    "laptop": _LAPTOP,
    # Half as many clouds of the target as the paper has, each of one view, as DepthScanNet10's.
    "full": replace(
        _LAPTOP,
        name="full",
        source_per_class=400,
        target_per_class=214,
        test_per_class=57,
        source_views=1,
        optimiser_steps=6000,
        sources=(*_LAPTOP.sources, "M-F", "S-F"),
    ),
    "small": Scale(
        name="small",
        source_per_class=48,
        target_per_class=20,
        test_per_class=20,
        train=TrainSettings(
            model="dgcnn", num_points=512, epochs=80, batch_size=16, validate_every=10
        ),
        ordinary=_SIMPLEVIEW | {"epochs": 80},
    ),
    "paper": Scale(
        name="paper",
        source_per_class=418,
        target_per_class=200,
        test_per_class=86,
        train=TrainSettings(model="dgcnn", num_points=1024, epochs=200, validate_every=20),
        ordinary=_SIMPLEVIEW,
        thetas=(0.5, 0.55, 0.6, 0.65, 0.7, 0.75, 0.8, 0.85, 0.9, 0.95),
        steps=(0.0, 0.0025, 0.005, 0.01, 0.02),
    ),
}
"""Sizes by name: ``laptop`` is the least that judges, on processors alone; ``full`` has seven times
its source and twice its target; ``paper`` has the paper's source, points and epochs."""
