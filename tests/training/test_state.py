import copy
from dataclasses import replace

import torch

from qs3.adaptation import SourceOnly
from qs3.training.checkpoint import new_model
from qs3.training.loop import train


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
