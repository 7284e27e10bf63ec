"""Training loop, self-training, runs, scores and predictions.

Settings and run folders load without PyTorch; it loads with the first training.
"""

from typing import TYPE_CHECKING

from qs3.lazy import loader

if TYPE_CHECKING:
    from qs3.training.augmentation import augment_clouds as augment_clouds
    from qs3.training.batches import load_whole as load_whole
    from qs3.training.checkpoint import save_model as save_model
    from qs3.training.classifier import Classifier as Classifier
    from qs3.training.config import PRESETS as PRESETS
    from qs3.training.config import Augmentation as Augmentation
    from qs3.training.config import SelfTrainingSettings as SelfTrainingSettings
    from qs3.training.config import TrainSettings as TrainSettings
    from qs3.training.fitting import FitResult as FitResult
    from qs3.training.fitting import fit as fit
    from qs3.training.history import EpochRecord as EpochRecord
    from qs3.training.loop import train as train
    from qs3.training.predict import LoadedModel as LoadedModel
    from qs3.training.predict import load_model as load_model
    from qs3.training.predict import predict_probabilities as predict_probabilities
    from qs3.training.progress import Deadline as Deadline
    from qs3.training.progress import TimeUpError as TimeUpError
    from qs3.training.progress import parse_duration as parse_duration
    from qs3.training.rounds import RoundRecord as RoundRecord
    from qs3.training.run import Run as Run
    from qs3.training.run import is_run as is_run
    from qs3.training.run import read_run as read_run
    from qs3.training.scoring import evaluate as evaluate
    from qs3.training.scoring import records_path as records_path
    from qs3.training.self_training import self_train as self_train
    from qs3.training.trainer import Checkpoint as Checkpoint
    from qs3.training.trainer import read_checkpoints as read_checkpoints

__getattr__ = loader(
    __name__,
    {
        "augmentation": "augment_clouds",
        "batches": "load_whole",
        "checkpoint": "save_model",
        "classifier": "Classifier",
        "config": "PRESETS Augmentation SelfTrainingSettings TrainSettings",
        "fitting": "FitResult fit",
        "history": "EpochRecord",
        "loop": "train",
        "predict": "LoadedModel load_model predict_probabilities",
        "progress": "Deadline TimeUpError parse_duration",
        "rounds": "RoundRecord",
        "run": "Run is_run read_run",
        "scoring": "evaluate records_path",
        "self_training": "self_train",
        "trainer": "Checkpoint read_checkpoints",
    },
)
