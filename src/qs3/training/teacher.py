"""What the teacher of a round says of the target: line 3 of Algorithm 1."""

import copy
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int
from lightning_fabric import Fabric

from qs3.adaptation.graph_labels import refine_probabilities
from qs3.io.clouds import PointClouds
from qs3.training.config import SelfTrainingSettings, TrainSettings
from qs3.training.predict import describe
from qs3.training.rounds import Rounds
from qs3.training.validation import adapt_statistics


class Answers(NamedTuple):
    """What a teacher says."""

    target: Float[np.ndarray, "m k"]
    """Class probabilities of the target, of which the pseudo labels are made."""
    held: tuple[Int[np.ndarray, "v"], Float[np.ndarray, "v k"]] | None
    """Classes and probabilities of the held-out part of the source, where they are asked for."""


def ask_teacher(
    state: Rounds,
    target: Float[np.ndarray, "m n 3"],
    holdout: PointClouds | None,
    settings: TrainSettings,
    rounds: SelfTrainingSettings,
    fabric: Fabric,
) -> Answers:
    """Ask the network that labels; all devices must call, all get the same."""
    teacher = state.latest if state.best is None else state.best.model
    if settings.normalisation == "adabn":
        teacher = copy.deepcopy(teacher)  # training goes on from the statistics of both domains
        adapt_statistics(teacher, target, settings.batch_size)
    size = settings.batch_size
    said = describe(teacher, target, batch_size=size, fabric=fabric)
    held = None
    if holdout is not None and len(holdout) and rounds.prior == "bbse":
        answers = describe(teacher, holdout.points, batch_size=size, fabric=fabric)
        held = holdout.labels, answers.probabilities
    if rounds.refine:
        return Answers(refine_probabilities(said.features, said.probabilities), held)
    return Answers(said.probabilities, held)
