"""From clouds to the answers of a trained run: class, confidence, CAD file and pose.

All commands with a run answer through `answer`, which also writes their CSV and JSON; `cloud_files`
lists and reads what they answer. Without a run ``qs3 locate`` answers through
`qs3.parts`, and ``qs3 find`` through `qs3.parts.scenes`.
"""

from typing import TYPE_CHECKING

from qs3.lazy import loader

if TYPE_CHECKING:
    from qs3.answers.answer import Answer as Answer
    from qs3.answers.classifier import Classifier as Classifier
    from qs3.answers.scoring import evaluate as evaluate

__getattr__ = loader(__name__)
