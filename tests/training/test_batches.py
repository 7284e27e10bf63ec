from dataclasses import replace

import numpy as np
import pytest
import torch

from qs3.clouds.preparation import PAPER, Preparation, unit_ball
from qs3.training.augmentation import augment
from qs3.training.prepared import first_places, prepare_clouds

CPU = torch.device("cpu")


def ready(clouds, device=CPU, num_points=64, preparation=PAPER):
    return prepare_clouds(clouds, num_points, preparation).on(device)


def generator(seed=0):
    return torch.Generator().manual_seed(seed)


def test_convention_anticlockwise_about_z(settings):
    still = replace(settings, jitter_sigma=0.0)
    points = torch.tensor([[[1.0, 0.0, 2.0], [0.0, 1.0, -1.0]]]).repeat(50, 1, 1)
    turned = augment(points, still, generator()).double().numpy()
    first, second = turned[:, 0], turned[:, 1]
    np.testing.assert_allclose(first[:, 2], 2.0)
    np.testing.assert_allclose(np.hypot(first[:, 0], first[:, 1]), 1.0, atol=1e-6)
    # y is x turned by a quarter anticlockwise.
    np.testing.assert_allclose(second[:, :2], np.stack([-first[:, 1], first[:, 0]], 1), atol=1e-6)
    angles = np.sort(np.arctan2(first[:, 1], first[:, 0]))
    assert np.diff(angles).max() < 1.0  # the whole circle is used


def test_jitter_is_clipped_gaussian(settings):
    still = replace(settings, rotate_z=False, jitter_sigma=0.01, jitter_clip=0.02)
    moves = augment(torch.zeros(8, 2000, 3), still, generator())
    assert moves.abs().max() <= 0.02
    # Variance of a Gaussian clipped at two sigma: 0.9205 σ² and mass at the rim.
    expected = 0.01 * np.sqrt(0.9205)
    assert abs(float(moves.std()) - expected) < 2e-4
    assert abs(float(moves.mean())) < 2e-4
    off = replace(still, jitter_sigma=0.0)
    assert torch.equal(augment(torch.ones(2, 3, 3), off, generator()), torch.ones(2, 3, 3))


def test_clouds_without_labels_are_taken(target):
    taken = ready(target.without_labels()).take(np.array([3, 1]))
    assert np.array_equal(taken.numpy(), unit_ball(target.points[[3, 1]]))


def test_clouds_stay_off_a_gpu_that_is_full(source, monkeypatch):
    """A quarter of the free memory is the limit; batches go to the device all the same."""
    monkeypatch.setattr("qs3.training.prepared._free_memory", lambda device: 0.0)
    clouds = ready(source, torch.device("meta"))
    assert clouds.held is None
    assert clouds.take(np.array([0])).device.type == "meta"
    monkeypatch.undo()
    assert ready(source, torch.device("meta")).held.device.type == "meta"


@pytest.mark.parametrize("preparation", [PAPER, Preparation(radius_share=0.9)])
def test_a_device_that_holds_the_clouds_gives_what_others_are_sent(
    source, monkeypatch, preparation
):
    rows = np.array([7, 0, 3])
    sent = ready(source, num_points=40, preparation=preparation)
    held = replace(sent, held=torch.from_numpy(source.points))
    for seed in (None, 0):
        draws = [None if seed is None else generator(seed) for _ in range(2)]
        first, second = sent.take(rows, draws[0]), held.take(rows, draws[1])
        assert torch.equal(first, second)


def test_points_are_drawn_among_those_that_are_kept():
    kept = torch.ones(2000, 30, dtype=torch.bool)
    kept[:, 20:] = False
    keys = torch.rand(2000, 30, generator=generator())
    drawn = first_places(kept, 15, keys)
    assert drawn.max() < 20
    assert all(len(set(row)) == 15 for row in drawn.tolist())  # none twice
    counts = torch.bincount(drawn.flatten(), minlength=20).double()
    # Each of 20 is drawn with probability 3/4: within five standard deviations.
    assert (counts / 2000 - 0.75).abs().max() < 5 * np.sqrt(0.75 * 0.25 / 2000)
    few = first_places(kept, 45, keys)
    assert all(
        sorted(np.bincount(row, minlength=20).tolist()) == [2] * 15 + [3] * 5 for row in few[:20]
    )


def test_redrawn_points_differ_and_the_fixed_choice_does_not(source, settings):
    clouds = ready(source, num_points=40, preparation=Preparation(redraw=True))
    rows = np.arange(4)
    draws = [clouds.take(rows, generator(seed)) for seed in (0, 0, 1)]
    assert torch.equal(draws[0], draws[1])
    assert not torch.equal(draws[0], draws[2])
    fixed = ready(source, num_points=40).take(rows, generator())
    assert torch.equal(clouds.take(rows), fixed)
    assert np.array_equal(clouds[rows], fixed.numpy())
    # As many points as there are leave nothing to draw.
    whole = ready(source, preparation=Preparation(redraw=True)).take(rows, generator())
    wanted = ready(source).take(rows)
    assert torch.equal(whole.sort(dim=1).values, wanted.sort(dim=1).values)
