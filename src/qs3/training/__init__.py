"""Training loop, self-training, runs, scores and predictions.

Settings and run folders load without PyTorch; it loads with the first training.
"""

from typing import TYPE_CHECKING

from qs3.lazy import loader

if TYPE_CHECKING:
    from qs3.training.checkpoint import save_model as save_model
    from qs3.training.classifier import Classifier as Classifier
    from qs3.training.config import PRESETS as PRESETS
    from qs3.training.config import Augmentation as Augmentation
    from qs3.training.config import SelfTrainingSettings as SelfTrainingSettings
    from qs3.training.config import TrainSettings as TrainSettings
    from qs3.training.fitting import FitResult as FitResult
    from qs3.training.fitting import fit as fit
    from qs3.training.loop import train as train
    from qs3.training.predict import load_model as load_model
    from qs3.training.predict import predict_probabilities as predict_probabilities
    from qs3.training.run import is_run as is_run
    from qs3.training.run import read_run as read_run
    from qs3.training.scoring import evaluate as evaluate
    from qs3.training.self_training import self_train as self_train

__getattr__ = loader(__name__)
