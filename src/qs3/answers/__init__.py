"""From clouds to answers: class, confidence, CAD file and pose, by one door for all commands."""

from typing import TYPE_CHECKING

from qs3.lazy import loader

if TYPE_CHECKING:
    from qs3.answers.answer import Answer as Answer
    from qs3.answers.classifier import Classifier as Classifier
    from qs3.answers.scoring import evaluate as evaluate

__getattr__ = loader(__name__)
