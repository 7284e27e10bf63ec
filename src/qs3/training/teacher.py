"""What the teacher of a round says of the target: line 3 of Algorithm 1."""

import copy
from functools import partial
from typing import NamedTuple

import numpy as np
from jaxtyping import Float, Int

from qs3.adaptation.confidence import fit_temperature, rescale
from qs3.adaptation.graph_labels import refine_probabilities
from qs3.errors import InputError
from qs3.geometry import rotation_z
from qs3.models import PointClassifier
from qs3.training.predict import Description, describe
from qs3.training.prepared import Prepared
from qs3.training.rounds import Rounds, Task
from qs3.training.validation import adapt_statistics


class Answers(NamedTuple):
    """What a teacher says."""

    target: Float[np.ndarray, "m k"]
    """Class probabilities of the target, of which the pseudo labels are made."""
    held: tuple[Int[np.ndarray, "v"], Float[np.ndarray, "v k"]] | None
    """Classes and probabilities of the held-out part of the source, where they are asked for."""
    temperature: float | None
    """What both are calibrated by; None where that is not asked for."""


def ask_teacher(state: Rounds, task: Task) -> Answers:
    """Ask the network that labels; all devices must call, all get the same.

    In this order, as far as the settings say so: answers are averaged over turns, calibrated on
    the held-out part of the source, and smoothed over a graph of similar clouds.

    Raises:
        InputError: where the calibration lacks a held-out part of the source.
    """
    rounds, holdout, target = task.rounds, task.holdout, task.target
    teacher = state.latest if rounds.teacher == "latest" else state.teacher.model
    if task.settings.normalisation == "adabn":
        teacher = copy.deepcopy(teacher)  # training goes on from the statistics of both domains
        adapt_statistics(teacher, target, task.settings.batch_size)
    said = _describe_turned(teacher, target, task)
    probabilities = said.probabilities
    held, temperature = None, None
    if holdout is not None and len(holdout) and (rounds.calibrate or rounds.prior == "bbse"):
        held = holdout.labels, _describe_turned(teacher, holdout, task).probabilities
    if rounds.calibrate:
        if held is None:
            raise InputError("calibrate needs a held-out part of the source; set holdout above 0")
        temperature = fit_temperature(held[1], held[0])
        held = held[0], rescale(held[1], temperature)
        probabilities = rescale(probabilities, temperature)
    if rounds.refine:
        probabilities = refine_probabilities(said.features, probabilities)
    return Answers(probabilities, held, temperature)


def _describe_turned(model: PointClassifier, clouds: Prepared, task: Task) -> Description:
    """Describe clouds; the mean over turns about z, of which the first is none."""
    turns, answers = task.rounds.turns, []
    ask = partial(describe, model, batch_size=task.settings.batch_size, fabric=task.fabric)
    for turn in range(turns):
        matrix = rotation_z(2 * np.pi * turn / turns).T.astype(np.float32)
        answers.append(ask(clouds.points @ matrix) if turn else ask(clouds))
    return Description(*(np.mean(parts, axis=0) for parts in zip(*answers, strict=True)))
