"""The cut of a depth picture, whatever its size."""

from dataclasses import replace

import cv2
import numpy as np
import pytest
import trimesh
from trimesh.transformations import rotation_matrix, translation_matrix

from qs3.errors import TOLD
from qs3.frames.camera_files import read_intrinsics
from qs3.objects.segment import SegmentSettings
from qs3.parts.scenes import picture as cutting
from qs3.parts.scenes.picture import picture_of, pieces_of
from qs3.parts.scenes.tabletop import blur_of

from ...objects.depth_scene import box, looking_down, photograph
from .tables import INTRINSICS, MATRIX, SHAPE, lain, shoot, smoothed, solid

CAMERA = read_intrinsics(INTRINSICS)


@pytest.mark.parametrize("times", [2, 4])
def test_a_large_picture_has_the_clusters_of_a_small_one(monkeypatch, times: int) -> None:
    """It is cut by some of its pixels; the others follow, up to the rims of the parts."""
    looked = []
    plain = cutting.table_of
    monkeypatch.setattr(cutting, "table_of", lambda p, s: looked.append(len(p)) or plain(p, s))
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


@pytest.mark.parametrize(
    ("seed", "down", "roll", "noise"),
    [(57, 86, 0, 0.003), (82, 74, 30, 0.003), (83, 77, 0, 0.003), (119, 90, 30, 0.0007),
     (144, 79, 30, 0.0007)],
)  # fmt: skip
def test_a_table_seen_from_above_is_no_plane_through_its_parts(
    seed: int, down: float, roll: float, noise: float
) -> None:
    """No level plane is there, as the camera looks down; planes through the boxes nearly are."""
    rng = np.random.default_rng(seed)
    things = [box((1.2, 1.2, 0.02), (-0.6, -0.6, -0.02))]
    if seed % 3 == 0:
        things.append(box((2.4, 0.02, 1.0), (-1.2, 0.5, -0.3)))
    for _ in range(rng.integers(1, 14)):
        size = rng.uniform(0.02, 0.12, 3) * (1, 1, rng.choice([0.2, 1]))
        place = translation_matrix((*rng.uniform(-0.28, 0.28, 2), size[2] / 2))
        turn = rotation_matrix(rng.uniform(0, 6), (0, 0, 1))
        things.append(trimesh.creation.box(size).apply_transform(place @ turn))
    rng.choice(5)
    pose = looking_down(down, (0, 0, 0))
    pose[:3, 3] = -rng.uniform(0.5, 0.9) * pose[:3, 2]
    pose = pose @ rotation_matrix(np.radians(roll), (0, 0, 1))
    matrix = np.array([[300, 0, 159.5], [0, 300, 119.5], [0, 0, 1.0]])
    depth, _ = photograph(solid(*things), pose, matrix, (240, 320))
    depth = depth + np.random.default_rng(seed).normal(scale=noise, size=depth.shape) * depth**2
    camera = read_intrinsics("300,300,159.5,119.5")
    picture = picture_of(depth.astype(np.float32), camera, SegmentSettings(gap=0.01, min_points=40))
    up, height = picture.table
    assert np.degrees(np.arccos(min(float(up @ np.linalg.inv(pose)[:3, 2]), 1.0))) < 1
    assert abs(height - pose[2, 3]) < 0.003
    assert abs(picture.noise - noise) < 0.3 * noise


@pytest.mark.parametrize("window", [1, 5, 9, 19])
def test_blur_is_half_the_window_that_the_camera_smooths_over(window: int) -> None:
    """Noise of a table shows it; coarse steps of depth, which are long along rows, do not."""
    shot = shoot(lain("block", 0.0, 0.0), noise=0)
    noise = cv2.blur(np.random.default_rng(0).normal(size=shot.depth.shape), (window, window))
    depth = shot.depth + shot.depth**2 * 0.003 * noise / noise.std()
    depth = np.where(shot.depth > 0, np.rint(depth / 0.001) * 0.001, 0).astype(np.float32)
    picture = picture_of(depth, CAMERA, SegmentSettings(gap=0.01, min_points=40))
    assert abs(picture.blur - window / 2) < 0.15 * window + 0.2
    assert picture.clusters == 1
    # Every other pixel of a large picture shows half as many of them.
    camera = read_intrinsics("860,860,319.5,239.5")
    twice = np.kron(depth, np.ones((2, 2), np.float32))
    large = picture_of(twice, camera, SegmentSettings(gap=0.01, min_points=40))
    assert abs(large.blur - 2 * picture.blur) < 0.1 * window + 0.2


@pytest.mark.parametrize("seed", [0, 6, 8, 12])
def test_noise_that_is_smoothed_is_no_object(seed: int) -> None:
    """It makes areas as wide as the window of the camera."""
    depth = smoothed(shoot(noise=0, focal=600.0), seed)
    camera = read_intrinsics("600,600,159.5,119.5")
    assert picture_of(depth, camera, SegmentSettings(gap=0.01, min_points=40)).clusters == 0


@pytest.mark.parametrize("blur", [0.0, 8.5])
def test_a_ramp_around_a_part_is_none_of_the_rest(blur: float) -> None:
    """It is half as wide as the window of the camera, and 2 pixels at least."""
    mask, claimed, rest = np.zeros((3, 120, 160), bool)
    claimed[40:80, 30:70] = True
    ramp = max(2, round(blur))
    mask[40 - ramp : 80 + ramp, 30 - ramp : 70 + ramp] = True
    rest[40:80, 110:150] = True
    (piece,) = pieces_of(mask | rest, claimed, 40, blur)
    np.testing.assert_array_equal(piece, rest)


@pytest.mark.parametrize(("tall", "is_cut"), [(0.03, False), (0.09, True)])
def test_parts_that_are_cut_at_the_height_are_reported(tall: float, is_cut: bool, caplog) -> None:
    """Seen from straight above in a bin, nothing is left of them."""
    TOLD.clear()
    bin_ = [box((0.3, 0.005, 0.05), (-0.15, y, 0)) for y in (-0.11, 0.105)]
    bin_ += [box((0.005, 0.22, 0.05), (x, -0.11, 0)) for x in (-0.15, 0.145)]
    part = box((0.04, 0.04, tall), (-0.02, -0.02, 0.0))
    camera = looking_down(90.0, (0.0, 0.0, 0.8))
    things = solid(box((1.2, 1.2, 0.02), (-0.6, -0.6, -0.02)), part, *bin_)
    depth, _ = photograph(things, camera, MATRIX, SHAPE)
    depth = depth + np.random.default_rng(0).normal(scale=0.0005, size=SHAPE)
    settings = SegmentSettings(gap=0.01, min_points=40, height=0.06)
    picture = picture_of(depth.astype(np.float32), CAMERA, settings)
    assert picture.clusters == 1 - is_cut
    messages = [record.getMessage() for record in caplog.records]
    assert [text.startswith("an object goes on above 0.06 m") for text in messages] == [
        True
    ] * is_cut


@pytest.mark.parametrize("wall", [2.0, 4.0])
def test_a_wall_behind_the_table_changes_neither_gap_nor_blur(wall: float, caplog) -> None:
    """It fills more of the picture than the table does, and its foot crosses the table's plane."""
    TOLD.clear()
    table = box((0.9, 0.8, 0.02), (-0.45, -0.55, -0.02))
    parts = [box((0.05, 0.03, 0.03), (x, 0.0, 0.0)) for x in (-0.1, -0.025, 0.05)]
    camera = looking_down(26.0, (0.0, -0.55, 0.42))
    matrix = np.array([[215, 0, 159.5], [0, 215, 119.5], [0, 0, 1.0]])
    things = solid(table, box((12, 0.1, 12), (-6, wall, -6)), *parts)
    depth, _ = photograph(things, camera, matrix, (240, 320))
    depth = depth + np.random.default_rng(0).normal(scale=0.001, size=depth.shape) * depth**2
    seen = read_intrinsics("215,215,159.5,119.5")
    picture = picture_of(depth.astype(np.float32), seen, SegmentSettings(gap=0.01, min_points=40))
    assert picture.clusters == 3
    assert picture.blur < 1
    assert not caplog.records  # it is higher than objects are, and no object


def test_wrinkles_of_a_cloth_are_no_blur() -> None:
    wave = 0.7 * np.sin(2 * np.pi * np.arange(320) / 60)
    noise = np.random.default_rng(0).normal(size=(240, 320))
    assert blur_of(wave + wave[:240, None] + noise) == 0


@pytest.mark.parametrize("heights", [np.zeros((40, 40)), np.full((40, 40), np.nan), np.eye(5)])
def test_a_table_without_noise_or_too_small_to_show_it_has_no_blur(heights: np.ndarray) -> None:
    assert blur_of(heights) == 0
