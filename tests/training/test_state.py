import copy
from dataclasses import replace

import pytest
import torch
from torch import nn

from qs3.adaptation import SourceOnly
from qs3.training.checkpoint import new_model
from qs3.training.loop import train
from qs3.training.state import averaged, make_average


def test_average_is_the_weighted_sum_of_all_states():
    module = nn.Sequential(nn.Linear(3, 2), nn.BatchNorm1d(2)).double()
    average = make_average(module, 0.6)
    states = [copy.deepcopy(module.state_dict())]
    for step in range(5):
        with torch.no_grad():
            for parameter in module.parameters():
                parameter.add_(torch.full_like(parameter, 0.1 * (step + 1)))
        module(torch.full((4, 3), float(step)).double() + torch.eye(4, 3).double())
        average.update_parameters(module)
        states.append(copy.deepcopy(module.state_dict()))
    decays = [min(0.6, (1 + t) / (10 + t)) for t in range(1, 6)]
    assert decays[0] == 2 / 11 and decays[-1] == 0.4
    for name, kept in average.module.state_dict().items():
        if not kept.is_floating_point():
            assert torch.equal(kept, states[-1][name])
            continue
        expected = states[0][name]
        for decay, state in zip(decays, states[1:], strict=True):
            expected = decay * expected + (1 - decay) * state[name]
        torch.testing.assert_close(kept, expected, rtol=1e-12, atol=1e-12)


def test_shown_is_put_back_even_after_a_fault():
    module = nn.Linear(1, 1)
    average = make_average(module, 0.9)
    start = copy.deepcopy(module.state_dict())
    with torch.no_grad():
        module.weight.add_(1)
    with pytest.raises(KeyError), averaged(module, average):
        assert torch.equal(module.weight, start["weight"])
        raise KeyError
    assert torch.equal(module.weight, start["weight"] + 1)


def test_training_returns_the_average_of_its_steps(source, settings):
    """The loop's result is what one gets by averaging its weights from outside, step by step."""
    states = []

    class Watch(SourceOnly):
        def after_step(self):
            states.append(copy.deepcopy(self.state_dict()))

    settings = replace(settings, epochs=2, ema_decay=0.7)
    plain = Watch(new_model(settings, 3, 0))
    expected = copy.deepcopy(plain.state_dict())
    train(plain, source, None, replace(settings, ema_decay=None))
    for step, state in enumerate(states, start=1):
        decay = min(0.7, (1 + step) / (10 + step))
        for name, tensor in state.items():
            if tensor.is_floating_point():
                expected[name].mul_(decay).add_(tensor, alpha=1 - decay)
            else:
                expected[name] = tensor
    averaged = SourceOnly(new_model(settings, 3, 0))
    seen = []

    def look(record, method):
        seen.append(copy.deepcopy(method.state_dict()))

    train(averaged, source, None, settings, on_epoch=look)
    for name, tensor in averaged.state_dict().items():
        torch.testing.assert_close(tensor, expected[name], rtol=1e-5, atol=1e-6)
        assert torch.equal(tensor, seen[-1][name])  # a callback sees the network that is kept
    assert not torch.equal(plain.model.state_dict()["early.0.linear.weight"],
                           averaged.model.state_dict()["early.0.linear.weight"])  # fmt: skip
