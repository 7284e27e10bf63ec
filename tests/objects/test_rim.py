"""Of a mask that bleeds goes what continues the background, and nothing of the object."""

import cv2
import numpy as np
import pytest

from qs3.objects.rim import on_object

HEIGHT, WIDTH, FOCAL, FOCAL_BASELINE = 120, 160, 300.0, 15.0
RNG = np.random.default_rng(0)


def table(noise: float = 0.05) -> np.ndarray:
    """Depth of a table that a camera half a metre off looks down on, with noise in pixels."""
    v = np.indices((HEIGHT, WIDTH))[0]
    inverse = (1 + 0.6 * (v - HEIGHT / 2) / FOCAL) / 0.5
    return noisy(1 / inverse, noise)


def noisy(depth: np.ndarray, noise: float) -> np.ndarray:
    disparity = FOCAL_BASELINE / depth + noise * RNG.standard_normal(depth.shape)
    return (FOCAL_BASELINE / disparity).astype(np.float32)


def laid(name: str) -> tuple[np.ndarray, np.ndarray]:
    """A depth image of a thing on the table, and the pixels that show it."""
    depth, mask = table(), np.zeros((HEIGHT, WIDTH), bool)
    if name == "box":
        mask[40:80, 50:100] = True
    elif name == "pin of four pixels":
        mask[58:62, 40:120] = True
    elif name == "ring":
        v, u = np.indices(mask.shape)
        radius = np.hypot(v - 60, u - 80)
        mask = (radius < 35) & (radius > 25)
    else:  # at the border of the image
        mask[30:90, :40] = True
    return np.where(mask, noisy(table(0.0) - 0.03, 0.05), depth).astype(np.float32), mask


THINGS = ("box", "pin of four pixels", "ring", "at the border")


def bled(mask: np.ndarray, pixels: int) -> np.ndarray:
    kernel = cv2.getStructuringElement(cv2.MORPH_ELLIPSE, (2 * pixels + 1,) * 2)
    return cv2.dilate(mask.astype(np.uint8), kernel) > 0


@pytest.mark.parametrize("pixels", [0, 1, 2, 3, 4])
@pytest.mark.parametrize("name", THINGS)
def test_what_a_mask_takes_in_of_the_table_goes_and_the_thing_stays(name, pixels):
    depth, mask = laid(name)
    wide = bled(mask, pixels)
    kept = on_object(depth, wide, ~wide, 4)
    assert not (kept & ~wide).any()
    assert kept[mask].all()  # it stands 3 cm off, 20 times the noise
    if pixels:
        assert kept[wide & ~mask].mean() < 0.05


def test_pixels_without_depth_stay_as_they_were():
    depth, mask = laid("box")
    wide = bled(mask, 2)
    for nothing in (0.0, np.nan):
        holes = depth.copy()
        holes[RNG.random(depth.shape) < 0.3] = nothing
        kept = on_object(holes, wide, ~wide, 4)
        assert kept[mask].all()
        assert kept[wide & ~mask & (holes > 0)].mean() < 0.05


def test_a_sheet_of_paper_keeps_all():
    depth, mask = table(), laid("box")[1]
    np.testing.assert_array_equal(on_object(depth, mask, ~mask, 4), mask)


def test_a_thing_before_a_hole_an_edge_or_alone_keeps_all():
    depth, mask = laid("box")
    wide = bled(mask, 2)
    hole = np.where(wide, depth, 0).astype(np.float32)
    np.testing.assert_array_equal(on_object(hole, wide, ~wide, 4), wide)
    rough = np.where(wide, depth, RNG.uniform(0.4, 0.9, depth.shape)).astype(np.float32)
    np.testing.assert_array_equal(on_object(rough, wide, ~wide, 4), wide)
    every = np.ones_like(mask)
    np.testing.assert_array_equal(on_object(depth, every, ~every, 4), every)


def test_another_object_beside_is_no_background():
    depth, mask = laid("box")
    left, right = mask.copy(), mask.copy()
    left[:, 75:], right[:, :75] = False, False
    assert on_object(depth, left, ~mask, 4)[left].all()
    assert on_object(depth, right, ~mask, 4)[right].all()


def test_a_width_of_0_leaves_the_mask_and_nothing_is_changed_in_place():
    depth, mask = laid("box")
    wide, before = bled(mask, 3), depth.copy()
    np.testing.assert_array_equal(on_object(depth, wide, ~wide, 0), wide)
    copied = wide.copy()
    on_object(depth, copied, ~wide, 4)
    np.testing.assert_array_equal(copied, wide)
    np.testing.assert_array_equal(depth, before)
    none = np.zeros_like(mask)
    assert not on_object(depth, none, ~none, 4).any()
