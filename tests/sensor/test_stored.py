"""A rig whose second image is the stored pattern."""

import cv2
import numpy as np
import pytest
import trimesh

from qs3.sensor.depth import DepthSettings
from qs3.sensor.exposure import ExposureSettings
from qs3.sensor.light.pattern import PatternSettings, stored_pattern
from qs3.sensor.matching import MatchingSettings
from qs3.sensor.placement import Placement
from qs3.sensor.presets import Sensor
from qs3.sensor.rig import StereoRig
from qs3.sensor.scan import scan

ONE_CAMERA = Sensor(
    name="one camera",
    rig=StereoRig(
        width=400, height=300, focal=420.0, baseline=0.2, projector_offset=1.0, second="pattern"
    ),
    pattern=PatternSettings(columns=177, rows=138),
    matching=MatchingSettings(num_disparities=64, block_size=13),
    exposure=ExposureSettings(noise=1.0),
    depth=DepthSettings(stride=1),
    placement=Placement(radius=(3.0, 3.0), elevation=(80.0, 80.0)),
)


def test_convention_a_dot_is_where_its_direction_says(tmp_path):
    # One lit cell of 9 × 6: third column, second row.
    picture = np.zeros((6, 9), np.uint8)
    picture[1, 2] = 255
    cv2.imwrite(str(tmp_path / "dot.png"), picture)
    pattern = PatternSettings(
        image=str(tmp_path / "dot.png"), tan_half_width=0.9, tan_half_height=0.6
    )
    rig = StereoRig(width=201, height=151, focal=100.0)
    seen = stored_pattern(rig, pattern, rig.full_frame).astype(float)
    v, u = np.mgrid[:151, :201]
    # Its centre: tan x = (2.5/9·2 − 1)·0.9 = −0.4, tan y = (1.5/6·2 − 1)·0.6 = −0.3.
    assert (seen * u).sum() / seen.sum() == pytest.approx(100 - 40, abs=0.05)
    assert (seen * v).sum() / seen.sum() == pytest.approx(75 - 30, abs=0.05)
    part = rig.full_frame.grown(-20, 201, 151)
    np.testing.assert_array_equal(stored_pattern(rig, pattern, part), seen[part.slices])


def test_nothing_is_stored_outside_the_cone():
    rig = StereoRig(width=400, height=300, focal=100.0)
    seen = stored_pattern(rig, PatternSettings(columns=30, rows=30), rig.full_frame)
    lit = np.argwhere(seen > 0)
    limit = 0.625 * 100
    assert np.abs(lit - [149.5, 199.5]).max() < limit + 1
    assert np.abs(lit - [149.5, 199.5]).max() > limit - 6


@pytest.fixture(scope="module")
def found(renderer):
    plate = trimesh.creation.box(extents=[1, 1, 0.02])
    return scan(plate, sensor=ONE_CAMERA, views=1, seed=0, renderer=renderer, keep_images=True)


def test_one_camera_and_the_stored_pattern_measure_depth(found):
    view = found.views[0]
    assert view.valid_fraction > 0.6
    assert abs(view.disparity_bias) < 0.1
    assert view.disparity_sigma < 0.4
    distance = trimesh.proximity.closest_point(found.mesh, found.points.astype(float))[1]
    assert np.median(distance) < 9 * 0.4 / 84


def test_the_right_image_is_the_pattern_itself_and_has_no_noise(found):
    images = found.images[0]
    whole = stored_pattern(ONE_CAMERA.rig, ONE_CAMERA.pattern, ONE_CAMERA.rig.full_frame)
    np.testing.assert_array_equal(images.right, whole[images.region.slices])
