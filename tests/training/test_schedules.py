"""The learning rate: PyTorch's own plateau, and a stop that does not change it."""

from dataclasses import replace

import numpy as np
import pytest
import torch

from qs3.adaptation import SourceOnly
from qs3.training.checkpoint import new_model
from qs3.training.loop import plateau, train

from .common import same, stop_after


def test_plateau_is_pytorchs():
    rng = np.random.default_rng(0)
    losses = np.abs(np.exp(-np.arange(150) / 20) + 0.05 * rng.normal(size=150)).tolist()
    weight = torch.nn.Parameter(torch.zeros(1))
    optimiser = torch.optim.Adam([weight], lr=2e-3)
    reference = torch.optim.lr_scheduler.ReduceLROnPlateau(
        optimiser, factor=0.5, patience=10, min_lr=1e-5, threshold=1e-4
    )
    rates = []
    for count, loss in enumerate(losses, start=1):
        reference.step(loss)
        rates.append(optimiser.param_groups[0]["lr"])
        assert plateau(losses[:count], 2e-3) * 2e-3 == pytest.approx(rates[-1], rel=1e-12)
    assert len(set(rates)) > 3


def test_plateau_ends_at_the_floor_and_a_rate_below_it_stays():
    assert plateau([1.0] * 500, 1e-3) == pytest.approx(1e-2)
    assert plateau([1.0] * 50, 1e-6) == 1.0


def test_training_follows_it_and_resumes_bit_exactly(source, settings, tmp_path):
    """So high a rate that the loss stalls again and again, stopped or not."""
    falling = replace(settings, epochs=60, batch_size=24, schedule="plateau", learning_rate=1.0)

    def run(folder, on_epoch=None, seed=0):
        method = SourceOnly(new_model(falling, 3, seed))
        history, _ = train(method, source, None, falling, run_dir=folder, on_epoch=on_epoch)
        return history, method.model

    history, whole = run(tmp_path / "whole")
    with pytest.raises(KeyboardInterrupt):
        run(tmp_path / "stopped", stop_after(50, KeyboardInterrupt))
    again, resumed = run(tmp_path / "stopped", seed=9)
    losses = [sum(record.losses.values()) for record in history]
    expected = [plateau(losses[:epoch], 1.0) for epoch in range(60)]
    assert [record.learning_rate for record in history] == expected
    assert [record.learning_rate for record in again] == expected
    assert len(set(expected)) > 1
    assert same(whole, resumed)
