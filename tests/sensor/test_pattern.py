import hashlib

import cv2
import numpy as np
import pytest
import trimesh
from PIL import ExifTags, Image
from scipy import signal
from scipy.spatial import cKDTree

from qs3.errors import InputError
from qs3.sensor.light import Body, LightSettings, Scene
from qs3.sensor.light.mitsuba import MitsubaRenderer
from qs3.sensor.light.pattern import (
    PatternSettings,
    pattern_image,
    rosette_places,
    speckle_pattern,
    spot_places,
    stored_pattern,
)
from qs3.sensor.rig import Pose, StereoRig


@pytest.mark.parametrize("seed", [0, 7])
def test_pattern_has_one_dot_in_nine_and_none_adjacent(seed):
    dots = speckle_pattern(633, 495, seed)
    assert dots.sum() == 633 * 495 // 9
    neighbours = cv2.filter2D(dots.astype(np.float32), -1, np.ones((3, 3), np.float32))
    assert neighbours[dots].max() == 1  # itself alone
    distance = cKDTree(np.argwhere(dots)).query(np.argwhere(dots), 2)[0][:, 1]
    assert distance.min() >= 2
    assert np.median(distance) <= 3


@pytest.mark.parametrize("draw", [speckle_pattern, spot_places, rosette_places])
def test_patterns_follow_their_seed(draw):
    assert draw(30, 30, 4).tobytes() == draw(30, 30, 4).tobytes()
    assert (draw(30, 30, 4) != draw(30, 30, 5)).any()
    with pytest.raises(InputError, match="multiples of"):
        draw(31, 30, 0)


def test_a_users_picture_is_projected_and_faults_name_it(tmp_path):
    picture = np.zeros((4, 6), np.uint8)
    picture[0, 5] = 255
    cv2.imwrite(str(tmp_path / "mine.png"), picture)
    image = pattern_image(PatternSettings(image=str(tmp_path / "mine.png")))
    np.testing.assert_array_equal(image, picture / 255)
    cut_out = np.dstack([np.full((4, 6, 3), 255, np.uint8), picture])  # white, the rest transparent
    cv2.imwrite(str(tmp_path / "cut.png"), cut_out)
    image = pattern_image(PatternSettings(image=str(tmp_path / "cut.png")))
    np.testing.assert_array_equal(image, picture / 255)
    exif = Image.Exif()
    exif[ExifTags.Base.Orientation] = 6  # beside transparency nothing is turned
    Image.fromarray(cut_out).save(tmp_path / "turned.png", exif=exif)
    image = pattern_image(PatternSettings(image=str(tmp_path / "turned.png")))
    np.testing.assert_array_equal(image, picture / 255)
    (tmp_path / "text.png").write_text("no picture")
    for name in ("text.png", "absent.png"):
        with pytest.raises(InputError, match=name):
            pattern_image(PatternSettings(image=str(tmp_path / name)))


@pytest.mark.parametrize("grey", [0, 200])
def test_a_picture_without_texture_is_refused(grey, tmp_path):
    cv2.imwrite(str(tmp_path / "grey.png"), np.full((4, 6), grey, np.uint8))
    with pytest.raises(InputError, match=r"grey\.png: is of nearly one grey"):
        pattern_image(PatternSettings(image=str(tmp_path / "grey.png")))


@pytest.mark.parametrize(
    ("size", "digest"), [((633, 495, 0), "53e5882594f997ae"), ((177, 138, 3), "5153553d342d93e2")]
)
def test_dots_stay_the_same_for_ever(size, digest):
    packed = np.packbits(speckle_pattern(*size)).tobytes()
    assert hashlib.sha256(packed).hexdigest()[:16] == digest


# Spots


@pytest.mark.parametrize(("columns", "rows", "seed"), [(270, 168, 5), (633, 495, 1)])
def test_every_tile_has_one_spot_and_none_is_near_another(columns, rows, seed):
    places = spot_places(columns, rows, seed)
    assert len(places) == (columns // 3) * (rows // 3)
    tiles = np.unique(places // 3, axis=0)
    assert len(tiles) == len(places)
    assert places.min() >= 0
    assert (places < [columns, rows]).all()
    distance = cKDTree(places).query(places, 2)[0][:, 1]
    assert distance.min() >= 1.5
    assert 1.9 < np.median(distance) < 2.2
    assert distance.max() < 3 * np.sqrt(8)


def self_correlation(image):
    """Correlation of the parts of a picture that overlap, at shifts up to half of it."""
    image = image - image.mean()
    ones = np.ones_like(image)
    both = signal.fftconvolve(ones, ones[::-1, ::-1])
    likeness = signal.fftconvolve(image, image[::-1, ::-1]) / (both * image.var())
    (h, w), (y, x) = image.shape, np.indices(likeness.shape)
    y, x = y - (h - 1), x - (w - 1)
    inner = (np.abs(y) <= h / 2) & (np.abs(x) <= w / 2)
    return likeness[inner], np.hypot(y, x)[inner]


def test_spots_are_like_themselves_at_no_distance():
    coarse = PatternSettings(columns=270, rows=168, kind="spots", spot_size=1.3, seed=1)
    image = pattern_image(coarse)
    cells = image.shape[1] / 270
    likeness, distance = self_correlation(image)
    assert likeness[distance == 0] == pytest.approx(1)
    assert np.abs(likeness[distance > 3 * cells]).max() < 0.05
    # The bound tells something: along a grid without the jitter it is broken at once.
    middles = np.zeros((168, 270), np.float32)
    middles[1::3, 1::3] = 1
    likeness, distance = self_correlation(middles)
    assert likeness[distance > 3].max() > 0.9


def test_rosettes_have_dense_rings_and_loose_petals_and_are_unlike_each_other():
    settings = PatternSettings(columns=240, rows=150, kind="rosettes", spot_size=0.83)
    places = rosette_places(240, 150, 0)
    assert len(places) == 240 * 150 / 9
    apart = cKDTree(places).query(places, 2)[0][:, 1].reshape(-1, 25)
    ring, petals = np.median(apart[:, :10]), np.median(apart[:, 10:])
    assert ring < 1.7 < 2 < petals
    # Nothing is far from a spot, and no two rosettes are alike.
    inside = np.random.default_rng(0).uniform((15, 15), (225, 135), (4000, 2))
    assert cKDTree(places).query(inside)[0].max() < 7
    image = pattern_image(settings)
    likeness, distance = self_correlation(image)
    assert np.abs(likeness[distance > 2 * image.shape[1] / 240]).max() < 0.12


def test_spots_are_gaussian_of_the_stated_width():
    settings = PatternSettings(columns=12, rows=9, kind="spots", spot_size=0.8, seed=2)
    image = pattern_image(settings)
    scale = image.shape[1] // 12
    assert image.shape == (9 * scale, 12 * scale)
    y, x = (np.indices(image.shape) + 0.5) / scale  # centres of texels, in cells
    wanted = np.zeros(image.shape)
    for column, row in spot_places(12, 9, 2):
        wanted += 0.5 ** (((x - column) ** 2 + (y - row) ** 2) / 0.4**2)
    np.testing.assert_allclose(image, np.minimum(wanted, 1), atol=2e-3)


@pytest.mark.parametrize("spot_size", [0.3, 2.0])
def test_pictures_of_spots_are_fine_enough_and_not_too_large(spot_size):
    image = pattern_image(PatternSettings(columns=300, rows=90, kind="spots", spot_size=spot_size))
    assert max(image.shape) <= 4096
    assert image.shape[1] / 300 * spot_size >= 2
    assert 0 <= image.min() < 0.01
    assert 0.9 < image.max() <= 1
    with pytest.raises(ValueError, match="read-only"):
        image[0, 0] = 1


def test_spots_too_fine_for_any_picture_are_refused():
    fine = PatternSettings(columns=3000, rows=300, kind="spots", spot_size=0.5)
    with pytest.raises(InputError, match="enlarge spot_size"):
        pattern_image(fine)


@pytest.mark.parametrize("indirect", ["cached", "path"])
def test_a_fine_picture_is_averaged_and_not_aliased_by_any_renderer(indirect, tmp_path):
    """One column in three is lit, of more than a renderer has texels: a third of the light."""
    rig, shone = StereoRig(60, 40, 80.0, 0.1), []
    wall = trimesh.creation.box(extents=[20, 20, 0.2]).apply_translation([0, 0, 3.1])
    light = LightSettings(projector=10.0, sky=0.0, sky_elevation=90.0, ambient=0.0)
    for first in (0, 1, 2, None):
        image = np.ones((8, 2048), np.float32)
        if first is not None:
            picture = np.zeros((24, 6144), np.uint8)
            picture[:, first::3] = 255
            path = str(tmp_path / f"{first}.png")
            cv2.imwrite(path, picture)
            image = pattern_image(PatternSettings(image=path))
        scene = Scene((Body(wall),), light, image, 0.6, 0.45)
        renderer = MitsubaRenderer(variant="scalar_rgb", samples=16, indirect=indirect)
        pair = renderer.render(scene, rig, [Pose(np.eye(4))], [0])[0]
        shone.append(pair.canvas(rig.full_frame)[0][5:-5, 5:-5])
    for lines in shone[:3]:  # in each pixel, not on the whole alone
        np.testing.assert_allclose(lines, shone[3] / 3, rtol=0.02)


# The stored pattern


@pytest.mark.parametrize(
    ("kind", "indirect"), [("tiles", "cached"), ("spots", "cached"), ("tiles", "path")]
)
def test_convention_stored_pattern_is_what_the_projector_throws(kind, indirect):
    rig = StereoRig(240, 180, 300.0, 0.2, projector_offset=1.0, second="pattern")
    depth, shift = 3.0, 20  # f·b/z
    pattern = PatternSettings(
        columns=120, rows=90, kind=kind, tan_half_width=0.6, tan_half_height=0.45
    )
    wall = trimesh.creation.box(extents=[20, 20, 0.2]).apply_translation([0, 0, depth + 0.1])
    light = LightSettings(projector=10.0, sky=0.0, sky_elevation=90.0, ambient=0.03)
    scene = Scene((Body(wall),), light, pattern_image(pattern), 0.6, 0.45)
    renderer = MitsubaRenderer(variant="scalar_rgb", samples=4, indirect=indirect)
    pair = renderer.render(scene, rig, [Pose(np.eye(4))], [0])[0]
    seen = pair.canvas(rig.full_frame)[0][20:-20, 40:-20].astype(float)
    stored = stored_pattern(rig, pattern, rig.full_frame).astype(float)

    def likeness(reference, right=0, down=0):
        part = reference[20 + down : 160 + down, 40 - shift + right : 220 - shift + right]
        return np.corrcoef(seen.ravel(), part.ravel())[0, 1]

    assert likeness(stored) > 0.95
    for turned in (stored[:, ::-1], stored[::-1], stored[::-1, ::-1]):
        assert abs(likeness(turned)) < 0.1
    assert likeness(stored, right=2 * shift) < 0.1  # the left camera's side is not the right's
    for step in ({"right": 1}, {"down": 1}):
        before, peak, after = (
            likeness(stored, **{k: n * v for k, v in step.items()}) for n in (-1, 0, 1)
        )
        assert abs((after - before) / (2 * (2 * peak - before - after))) < 0.03
