"""What the stages of one training share: settings, folder, checkpoints, history."""

import copy
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from torch import Tensor

from qs3.adaptation import Method
from qs3.adaptation.confidence import Known, measure_known
from qs3.evaluation.metrics import accuracy
from qs3.io.clouds import PointClouds
from qs3.models import PointClassifier
from qs3.training.checkpoint import save_model
from qs3.training.config import TrainSettings
from qs3.training.device import choose_device
from qs3.training.history import EpochRecord, History
from qs3.training.loop import EpochCallback, train
from qs3.training.predict import describe
from qs3.training.prepared import Prepared
from qs3.training.progress import Deadline
from qs3.training.rounds import RoundRecord
from qs3.training.trained import Description
from qs3.training.validation import (
    CHECKPOINTS,
    Checkpoint,
    choose,
    load_checkpoint,
    read_checkpoints,
)

RoundCallback = Callable[[RoundRecord, PointClassifier], None]
"""Called after each round, when its state is written."""


class Trainer:
    """Trains the stages of one run.

    Args:
        settings: How to train.
        class_names: Classes of the network.
        folder: Folder of the run; None writes nothing.
        holdout: Held-out part of the source; None if there is none.
        deadline: Ends the run before an epoch that would end too late.
        on_epoch: Called after each epoch.
        on_round: Called after each round of self-training.
    """

    def __init__(
        self,
        settings: TrainSettings,
        class_names: Sequence[str],
        folder: Path | None = None,
        *,
        holdout: Prepared[PointClouds] | None = None,
        deadline: Deadline | None = None,
        on_epoch: EpochCallback | None = None,
        on_round: RoundCallback | None = None,
    ) -> None:
        self.settings, self.class_names, self.folder = settings, tuple(class_names), folder
        self.holdout, self.deadline = holdout, deadline
        self.on_epoch, self.on_round = on_epoch, on_round
        self.device = choose_device(settings)
        self.checkpoints = [] if folder is None else read_checkpoints(folder)
        self.history = History(folder)
        if self.checkpoints:
            self.history.put("checkpoint", self.checkpoints)

    def train(
        self,
        method: Method,
        source: Any,
        target: Any,
        stage: str,
        settings: TrainSettings | None = None,
        *,
        description: str = "",
        **options: Any,
    ) -> tuple[list[EpochRecord], dict[str, Tensor]]:
        """Train one stage by `qs3.training.loop.train`, and record its epochs."""
        return train(
            method,
            source,
            target,
            settings or self.settings,
            on_epoch=self.on_epoch,
            log=lambda epochs: self.history.put("epoch", epochs, stage),
            deadline=self.deadline,
            description=description or stage,
            **options,
        )

    def after_epoch(self, stage: str, method: Method, epoch: int) -> None:
        """Write a checkpoint if one is due."""
        done, every = epoch + 1, self.settings.validate_every
        if every and (done == self.settings.epochs or done % every == 0):
            self.checkpoint(stage, done, method.model)

    def checkpoint(self, stage: str, number: int, model: PointClassifier) -> None:
        """Score a network on the held-out part of the source, and write its weights."""
        if self.folder is None or not self.settings.validate_every:
            return
        model = copy.deepcopy(model).to(self.device)  # training goes on from its own statistics
        right = None
        if self.holdout is not None and len(self.holdout):
            answers = self.describe(model, self.holdout).probabilities.argmax(axis=1)
            right = accuracy(self.holdout.labels, answers)
        facts = {"stage": stage, "number": number, "source_accuracy": right}
        name = f"{CHECKPOINTS}/{stage}-{number:04d}.safetensors"
        save_model(self.folder, model, self.class_names, self.settings, name=name, facts=facts)
        others = [made for made in self.checkpoints if made.file != name]
        made = [*others, Checkpoint(stage, number, right, name)]
        self.checkpoints = sorted(made, key=lambda each: (each.stage, each.number))
        self.history.put("checkpoint", self.checkpoints)

    def of_stage(self, stage: str) -> list[Checkpoint]:
        """Return the checkpoints of a stage, in order."""
        return [made for made in self.checkpoints if made.stage == stage]

    def choose(self, stage: str, model: PointClassifier, last: int) -> int:
        """Load the weights that the rule chooses, and return their number: ``last``, or another."""
        if self.folder is None or self.settings.rule == "last":
            return last
        picked = choose(self.of_stage(stage), self.settings.rule)
        load_checkpoint(self.folder, picked, model)
        return picked.number

    def known(self, model: PointClassifier) -> Known | None:
        """Measure how a network answers the held-out part; None if there is none."""
        if self.holdout is None:
            return None
        return measure_known(self.describe(model, self.holdout).logits, self.holdout.labels)

    def describe(self, model: PointClassifier, clouds: Prepared) -> Description:
        """Return the answers of a network, computed as in the training."""
        how = {"batch_size": self.settings.batch_size, "precision": self.settings.precision}
        return describe(model, clouds, **how)
