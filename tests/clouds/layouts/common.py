"""Clouds to write and read back."""

import numpy as np

from qs3.clouds.types import RaggedClouds
from qs3.meshes.classes import POINTDA10


def make_clouds(rng, classes=POINTDA10, num_points=64, per_part=1, splits=("train", "test")):
    """Clouds of every class and split, with coordinates of all magnitudes."""
    ids, labels, parts, clouds = [], [], [], []
    for label, name in enumerate(classes):
        for part in splits:
            for number in range(per_part):
                ids.append(f"{name}/{part}/{name}_{number:04d}.off#0")
                labels.append(label)
                parts.append(part)
                clouds.append(hard_floats(rng, num_points))
    return RaggedClouds(
        clouds=clouds,
        ids=tuple(ids),
        checksum="0" * 64,
        labels=np.array(labels, dtype=np.int64),
        class_names=tuple(classes),
        splits=tuple(parts) if any(parts) else (),
    )


def hard_floats(rng, count):
    """Finite float32 of every exponent, with both zeros and subnormals, by their bits."""
    bits = rng.integers(0, 2**32, size=(count, 3), dtype=np.uint32)
    values = bits.view(np.float32)
    values = np.where(np.isfinite(values), values, np.float32(-0.0))
    values[0] = (0.1, -0.0, np.float32(1e-45))
    return values


def content(clouds):
    """What a cloud is, whatever its place and id: class, split and bytes of its points."""
    names = [clouds.class_names[label] for label in clouds.labels]
    splits = clouds.splits or ("",) * len(names)
    points = [np.asarray(cloud, dtype="<f4").tobytes() for cloud in clouds.clouds]
    return sorted(zip(names, splits, points, strict=True))
