"""The folder of a run: settings, weights, history and records, and the runs that qs3 brings.

It loads without PyTorch, but for the weights of networks.
"""

from typing import TYPE_CHECKING

from qs3.lazy import loader

if TYPE_CHECKING:
    from qs3.runs.run import is_run as is_run
    from qs3.runs.run import read_run as read_run
    from qs3.runs.settings import PRESETS as PRESETS
    from qs3.runs.settings import Augmentation as Augmentation
    from qs3.runs.settings import SelfTrainingSettings as SelfTrainingSettings
    from qs3.runs.settings import TrainSettings as TrainSettings
    from qs3.runs.weights import save_model as save_model

__getattr__ = loader(__name__)
