"""Training of networks: the loop, self-training in rounds, and predictions.

`qs3.parts.forest_training` trains forests.

PyTorch loads with the first training.
"""

from typing import TYPE_CHECKING

from qs3.lazy import loader

if TYPE_CHECKING:
    from qs3.training.fitting import FitResult as FitResult
    from qs3.training.fitting import fit as fit
    from qs3.training.loop import train as train
    from qs3.training.predict import load_model as load_model
    from qs3.training.predict import predict_probabilities as predict_probabilities
    from qs3.training.self_training import self_train as self_train

__getattr__ = loader(__name__)
