"""A moving average of a network over the steps of its training."""

from collections.abc import Iterator, Mapping
from contextlib import contextmanager

import torch
from torch import Tensor, nn


class Average:
    """Exponential moving average of all parameters and buffers of a module.

    After step t the average moves by 1 − d towards the module, d = min(decay, (1 + t)/(10 + t)):
    the first steps, far from where the training ends, are soon forgotten. Running statistics of
    batch normalisation are averaged like weights; integers (its count of batches) are copied.

    Args:
        module: The module; the average begins at its state.
        decay: The largest d, between 0 and 1.

    Example:
        >>> layer = nn.Linear(1, 1)
        >>> average = Average(layer, 0.9)
        >>> average.update()
        >>> torch.equal(average.tensors()["weight"], layer.weight)
        True
    """

    def __init__(self, module: nn.Module, decay: float) -> None:
        self.module, self.decay, self.steps = module, decay, 0
        self.state = {name: t.detach().clone() for name, t in module.state_dict().items()}

    @torch.no_grad()
    def update(self) -> None:
        """Move the average towards the module, after a step."""
        self.steps += 1
        move = 1.0 - min(self.decay, (1 + self.steps) / (10 + self.steps))
        for name, tensor in self.module.state_dict().items():
            if tensor.is_floating_point():
                self.state[name].lerp_(tensor, move)
            else:
                self.state[name].copy_(tensor)

    @contextmanager
    def shown(self) -> Iterator[None]:
        """Let the module hold the average for a while."""
        held = {name: t.detach().clone() for name, t in self.module.state_dict().items()}
        self.module.load_state_dict(self.state)
        try:
            yield
        finally:
            self.module.load_state_dict(held)

    def settle(self) -> None:
        """Let the module hold the average for good."""
        self.module.load_state_dict(self.state)

    def tensors(self) -> dict[str, Tensor]:
        """Return what to store in the checkpoint, beside `steps`."""
        return dict(self.state)

    def load(self, tensors: Mapping[str, Tensor], steps: int) -> None:
        """Take back what `tensors` returned."""
        self.steps = steps
        for name, tensor in self.state.items():
            tensor.copy_(tensors[name])
