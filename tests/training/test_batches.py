from dataclasses import replace

import numpy as np
import pytest
import torch

from qs3.training.batches import DeviceClouds, Share, augment, batches, make_batch

CPU = torch.device("cpu")


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


@pytest.mark.parametrize("world", [2, 3])
def test_shares_are_the_whole_batch_once(source, target, settings, world):
    sets = [DeviceClouds(source, CPU), DeviceClouds(target, CPU)]
    rows = [np.array([5, 0, 7, 3, 9, 11, 2]), np.arange(6)]
    whole = make_batch(sets, rows, settings, generator())
    parts = [
        make_batch(sets, rows, settings, generator(), Share(rank, world)) for rank in range(world)
    ]
    order = [
        place
        for rank in range(world)
        for start, count in ((0, 7), (7, 6))
        for place in range(start + rank, start + count, world)
    ]
    assert sorted(order) == list(range(13))
    assert torch.equal(torch.cat([part.points for part in parts]), whole.points[order])
    assert torch.equal(torch.cat([part.labels for part in parts]), whole.labels[order])
    assert torch.equal(whole.labels[:7], torch.from_numpy(source.labels[rows[0]]))


def test_last_batch_too_small_for_all_devices_is_dropped():
    assert [len(rows) for rows in batches(11, 4, np.random.default_rng(0), 4)] == [4, 4]
    assert [len(rows) for rows in batches(12, 8, np.random.default_rng(0), 4)] == [8, 4]


def test_clouds_without_labels_are_taken(target):
    clouds = DeviceClouds(target.without_labels(), CPU)
    taken = clouds.take(np.array([3, 1]))
    assert np.array_equal(taken.points.numpy(), target.points[[3, 1]])
    assert not taken.labels.any()


def test_clouds_stay_off_a_gpu_that_is_full(source, monkeypatch):
    """A quarter of the free memory is the limit; batches go to the device all the same."""
    monkeypatch.setattr("qs3.training.batches._free_memory", lambda device: 0.0)
    clouds = DeviceClouds(source, torch.device("meta"))
    assert clouds.points.device.type == "cpu"
    assert clouds.take(np.array([0])).points.device.type == "meta"
    monkeypatch.undo()
    assert DeviceClouds(source, torch.device("meta")).points.device.type == "meta"
