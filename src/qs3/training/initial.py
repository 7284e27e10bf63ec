"""The network and the method that a training begins with."""

import contextlib
from dataclasses import replace

import torch

from qs3.adaptation import Method, create_method, method_class
from qs3.errors import InputError
from qs3.models import PointClassifier, feature_widths
from qs3.training.checkpoint import derived_seed, new_model
from qs3.training.config import TrainSettings


def make_method(name: str, model: PointClassifier, settings: TrainSettings) -> Method:
    """Return the method that trains the network; what else it trains is drawn from the seed."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(derived_seed(settings.seed, 4))
        return create_method(
            name, model, label_smoothing=settings.label_smoothing, **settings.method_settings
        )


def fresh_model(method: str, settings: TrainSettings, count: int) -> PointClassifier:
    """Return the network with its first weights; it has local features if the method needs them."""
    seed = derived_seed(settings.seed, 0)
    model = new_model(settings, count, seed)
    if method_class(method).needs_local and feature_widths(model).local is None:
        # Only a setting of what `encode` gives: the weights are the same.
        wider = dict(settings.model_settings) | {"local": True}
        with contextlib.suppress(InputError):
            return new_model(replace(settings, model_settings=wider), count, seed)
    return model
