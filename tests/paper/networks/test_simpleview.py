"""SimpleView: its images against a camera drawn by hand."""

import numpy as np
import pytest
import torch
from torch import nn

from qs3.models import create_model
from qs3.paper.networks.simpleview import depth_images
from qs3.runs.settings import TrainSettings
from qs3.runs.weights import read_tensors, save_model, write_tensors
from qs3.training.predict import load_model

from ...models.common import NETWORKS, make, textbook

SIDES = np.array([[1, 0, 0], [0, 1, 0], [-1, 0, 0], [0, -1, 0], [0, 0, 1], [0, 0, -1.0]])
UPS = np.array([[0, 0, 1]] * 4 + [[0, 1, 0], [0, -1, 0.0]])


def ball(b=2, n=300, seed=0, dtype=torch.float64):
    generator = torch.Generator().manual_seed(seed)
    points = torch.randn(b, n, 3, generator=generator, dtype=torch.float64)
    radius = torch.rand(b, n, 1, generator=generator, dtype=torch.float64)
    return (nn.functional.normalize(points, dim=2) * radius).to(dtype)


def drawn_by_hand(cloud, size):
    """Orthographic, point by point, with cameras that look at the origin from 1.4 away."""
    images = np.zeros((6, size, size))
    for image, side, up in zip(images, SIDES, UPS, strict=True):
        forward = -side
        right = np.cross(forward, up)
        down = np.cross(forward, right)
        hits = {}
        for point in cloud:
            depth = (point - 1.4 * side) @ forward
            x, y = point @ right, point @ down
            pixel = tuple(int(np.rint((c + 1) / 2 * (size - 1))) for c in (y, x))
            if all(0 <= c < size for c in pixel):
                hits.setdefault(pixel, []).append(depth)
        for pixel, depths in hits.items():
            image[pixel] = min(depths)
    return images


@pytest.mark.parametrize("size", [16, 33])
def test_orthographic_images_are_those_drawn_by_hand(size):
    points = ball()
    images = depth_images(points, size, "orthographic")
    expected = np.stack([drawn_by_hand(c, size) for c in points.numpy()])
    assert (expected > 0).mean() > 0.05
    np.testing.assert_allclose(images.numpy(), expected, rtol=0, atol=1e-10)


@pytest.mark.parametrize("size", [16, 33])
def test_images_are_those_of_the_release(size):
    points = ball()
    images = depth_images(points, size)
    expected = textbook("simpleview").depth_images(points, size)
    assert (expected > 0).double().mean() > 0.05
    torch.testing.assert_close(images, expected, rtol=0, atol=1e-10)


def test_convention_pixels_are_those_of_the_release():
    """Worked out by hand: rows and columns are ⌈(c/z + 1) · w/2 − 1/2⌉, halves fall."""
    # From +x: rows go down, columns to −y. Depths 1.4, 0.9, and 1.0 and 0.7 in one pixel.
    points = [[0, 0, 0], [0.5, -0.3, 0.3], [0.4, 0.5, -0.5], [0.7, 0.35, -0.35]]
    image = depth_images(torch.tensor([points], dtype=torch.float64), 8)[0, 0]
    expected = torch.zeros(8, 8, dtype=torch.float64)
    expected[4, 4] = 1.4  # ⌈4 − 1/2⌉
    expected[3, 5] = 0.9  # rows ⌈(−1/3 + 1) · 4 − 1/2⌉, columns ⌈(1/3 + 1) · 4 − 1/2⌉
    expected[6, 2] = 2 / (1 / 1.0 + 1 / 0.7)  # rows ⌈5.5⌉, columns ⌈1.5⌉
    torch.testing.assert_close(image, expected)


def test_weights_remember_their_cameras(tmp_path):
    settings = TrainSettings(model="simpleview", model_settings=NETWORKS["simpleview"])
    model = create_model("simpleview", 3, **NETWORKS["simpleview"]).eval()
    path = save_model(tmp_path, model, ("a", "b", "c"), settings)
    points = ball().float()
    torch.testing.assert_close(load_model(path).model(points), model(points))
    # As written up to version 0.2, without the mark.
    old = create_model("simpleview", 3, projection="orthographic", **NETWORKS["simpleview"]).eval()
    path = save_model(tmp_path, old, ("a", "b", "c"), settings)
    tensors, facts = read_tensors(path)
    write_tensors(path, {k: v for k, v in tensors.items() if k != "perspective"}, facts)
    read = load_model(path).model
    torch.testing.assert_close(read(points), old(points))
    again = save_model(tmp_path, read, ("a", "b", "c"), settings)
    torch.testing.assert_close(load_model(again).model(points), old(points))
    assert (old(points) - model(points)).abs().max() > 1e-3


LETTER = ("#####", "#....", "###..", "#....", "#....")


@pytest.mark.parametrize("view", range(6))
def test_convention_orthographic_views_are_upright_and_not_mirrored(view):
    """An F, written where somebody who stands at the camera reads it, is read in the image."""
    # Right and up of the reader at +x, +y, −x, −y, +z (a map) and −z, written out by hand.
    rights = ((0, 1, 0), (-1, 0, 0), (0, -1, 0), (1, 0, 0), (1, 0, 0), (1, 0, 0))
    ups = ((0, 0, 1), (0, 0, 1), (0, 0, 1), (0, 0, 1), (0, 1, 0), (0, -1, 0))
    right, up = np.array(rights[view]), np.array(ups[view])
    cloud = [
        (column - 2) / 2 * right + (2 - row) / 2 * up
        for row, line in enumerate(LETTER)
        for column, mark in enumerate(line)
        if mark == "#"
    ]
    image = depth_images(torch.tensor(np.array(cloud))[None], 5, "orthographic")[0, view]
    read = ["".join("#" if depth > 0 else "." for depth in row) for row in image.tolist()]
    assert tuple(read) == LETTER
    torch.testing.assert_close(image[image > 0], torch.full((11,), 1.4, dtype=torch.float64))


@pytest.mark.parametrize("projection", ["perspective", "orthographic"])
def test_points_beyond_the_image_are_not_seen(projection):
    inside = ball(n=50)
    outside = torch.tensor([[[0.0, 30, 0], [-30, 3, 3], [0, 0, -1e20], [torch.nan, 0, 0]]])
    both = torch.cat([inside, outside.double().expand(2, -1, -1)], dim=1)
    away = [2]  # the camera on −x: what lies there lies beyond its image or behind it
    images = depth_images(both, 16, projection)
    assert images.isfinite().all()
    assert torch.equal(images[:, away], depth_images(inside, 16, projection)[:, away])
    if projection == "orthographic":
        assert not depth_images(inside + 30, 16, projection).any()


def test_pooled_holds_each_view_in_its_place():
    model = make("simpleview").eval()
    images = depth_images(ball(), 24)
    alone = [model.backbone(images[:, view, None]) for view in range(6)]
    pooled = model.encode(ball()).pooled
    torch.testing.assert_close(pooled, torch.cat(alone, dim=1), rtol=0, atol=1e-12)


def test_default_is_the_published_network():
    # Goyal et al., Table 4: 0.8 M parameters. The release has 803,992; 128 of them are a bias
    # before a normalisation.
    model = create_model("simpleview", 40)
    assert sum(p.numel() for p in model.parameters()) == 803_992 - 128
    assert model.resolution == 128
