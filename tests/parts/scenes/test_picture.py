"""The cut of a depth picture, whatever its size."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from qs3.frames.intrinsics import read_intrinsics
from qs3.objects.segment import SegmentSettings
from qs3.parts.scenes import picture as cutting
from qs3.parts.scenes.picture import picture_of

from .tables import INTRINSICS, lain, shoot

CAMERA = read_intrinsics(INTRINSICS)


@pytest.mark.parametrize("times", [2, 4])
def test_a_large_picture_has_the_clusters_of_a_small_one(monkeypatch, times: int) -> None:
    """It is cut by some of its pixels; the others follow, up to the rims of the parts."""
    looked = []
    own = cutting.table_of
    monkeypatch.setattr(cutting, "table_of", lambda p, s: looked.append(len(p)) or own(p, s))
    shot = shoot(lain("bracket", -0.1, 0.0, 20), lain("pin", 0.0, 0.06), lain("block", 0.1, 0, 70))
    small = picture_of(shot.depth, CAMERA, SegmentSettings(gap=0.01, min_points=40))
    wide = shot.depth.repeat(times, axis=0).repeat(times, axis=1)
    camera = replace(
        CAMERA,
        fx=times * CAMERA.fx, fy=times * CAMERA.fy,
        cx=times * (CAMERA.cx + 0.5) - 0.5, cy=times * (CAMERA.cy + 0.5) - 0.5,
    )  # fmt: skip
    settings = SegmentSettings(gap=0.01, min_points=40 * times**2)
    large = picture_of(wide, camera, settings)
    assert max(looked) <= cutting._CUT
    assert large.clusters == small.clusters >= 3
    expected = small.cluster.repeat(times, axis=0).repeat(times, axis=1)
    around = np.ones((7, 7), np.uint8)
    labels = expected.astype(np.float32)
    inner = cv2.dilate(labels, around) == cv2.erode(labels, around)
    assert inner.mean() > 0.9
    assert (large.cluster == expected)[inner].all()
    assert (large.cluster == expected).mean() > 0.995
    np.testing.assert_allclose(large.camera_from_table, small.camera_from_table, atol=0.002)
