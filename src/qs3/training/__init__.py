"""The training loop, self-training in rounds, checkpoints and predictions."""

from qs3.training.batches import prepare as prepare
from qs3.training.checkpoint import LoadedModel as LoadedModel
from qs3.training.checkpoint import load_model as load_model
from qs3.training.checkpoint import save_model as save_model
from qs3.training.config import PRESETS as PRESETS
from qs3.training.config import SelfTrainingSettings as SelfTrainingSettings
from qs3.training.config import TrainSettings as TrainSettings
from qs3.training.config import self_training_preset as self_training_preset
from qs3.training.deadline import Deadline as Deadline
from qs3.training.deadline import TimeUpError as TimeUpError
from qs3.training.deadline import parse_duration as parse_duration
from qs3.training.estimators import QBST as QBST
from qs3.training.estimators import SPST as SPST
from qs3.training.estimators import Adapter as Adapter
from qs3.training.fit import FitResult as FitResult
from qs3.training.fit import fit as fit
from qs3.training.fit import is_finished as is_finished
from qs3.training.loop import train as train
from qs3.training.predict import predict_probabilities as predict_probabilities
from qs3.training.records import EpochRecord as EpochRecord
from qs3.training.self_training import RoundRecord as RoundRecord
from qs3.training.self_training import self_train as self_train
from qs3.training.thinning import thin as thin
from qs3.training.validation import Checkpoint as Checkpoint
from qs3.training.validation import adapt_statistics as adapt_statistics
from qs3.training.validation import read_checkpoints as read_checkpoints
