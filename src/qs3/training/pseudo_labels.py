"""Lines 3 to 17 of Algorithm 1: what the teacher says of the target, and what is selected of it."""

from functools import partial
from typing import NamedTuple

import numpy as np
from jaxtyping import Bool, Float, Int

from qs3.adaptation.confidence import fit_temperature, rescale, threshold_of_share
from qs3.adaptation.graph_labels import refine_probabilities
from qs3.adaptation.priors import estimate_prior_bbse, estimate_prior_em
from qs3.adaptation.selection import (
    select_confident,
    select_prior,
    select_quantile,
    select_quasi_balanced,
    select_uniform,
    with_floor,
)
from qs3.errors import InputError
from qs3.evaluation.metrics import confusion_matrix
from qs3.training.config import SelfTrainingSettings
from qs3.training.predict import describe_turned
from qs3.training.rounds import Rounds, Task


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
    how = {"batch_size": task.settings.batch_size, "fabric": task.fabric}
    ask = partial(describe_turned, teacher, turns=rounds.turns, **how)
    said = ask(target)
    probabilities = said.probabilities
    held, temperature = None, None
    if holdout is not None and len(holdout) and (rounds.calibrate or rounds.prior == "bbse"):
        held = holdout.labels, ask(holdout).probabilities
    if rounds.calibrate:
        if held is None:
            raise InputError("calibrate needs a held-out part of the source; set holdout above 0")
        temperature = fit_temperature(held[1], held[0])
        held = held[0], rescale(held[1], temperature)
        probabilities = rescale(probabilities, temperature)
    if rounds.refine:
        probabilities = refine_probabilities(said.features, probabilities)
    return Answers(probabilities, held, temperature)


def round_threshold(
    rounds: SelfTrainingSettings, number: int, probabilities: Float[np.ndarray, "m k"]
) -> float:
    """Return θ of a round; 0 where each class has a threshold of its own.

    Args:
        rounds: Its numbers.
        number: Count of the round, from 1.
        probabilities: Of the clouds to select from, for a θ that is their quantile.
    """
    if rounds.rule == "quantile":
        return 0.0
    if rounds.threshold_share is not None:
        share = rounds.threshold_share
        return threshold_of_share(probabilities, share, inclusive=rounds.inclusive)
    return rounds.threshold + (number - 1) * rounds.step


def select_clouds(
    probabilities: Float[np.ndarray, "m k"],
    theta: float,
    rounds: SelfTrainingSettings,
    number: int,
    labels: Int[np.ndarray, "s"],
    held: tuple[np.ndarray, np.ndarray] | None,
) -> Bool[np.ndarray, "m"]:
    """Select clouds of a round by the rule of the settings.

    Args:
        probabilities: Of the clouds to select from.
        theta: Threshold of the round.
        rounds: Which rule, and its numbers.
        number: Count of the round, from 1.
        labels: Classes of the source's clouds, for the prior that EM starts from.
        held: Classes and probabilities of the held-out part of the source, for BBSE.

    Raises:
        InputError: where BBSE has no held-out part.
    """
    over = {"threshold": theta, "inclusive": rounds.inclusive}
    if rounds.rule == "spst":
        chosen = select_confident(probabilities, **over)
    elif rounds.rule == "uniform":
        chosen = select_uniform(probabilities, quantile=rounds.quantile, **over)
    elif rounds.rule == "prior":
        prior = _prior(rounds, probabilities, labels, held)
        chosen = select_prior(probabilities, prior=prior, quantile=rounds.quantile, **over)
    elif rounds.rule == "quantile":
        # Rounded: 0.2 + 2 · 0.05 is a little over 0.3, which would keep one cloud more.
        portion = min(1.0, round(rounds.portion + (number - 1) * rounds.portion_step, 12))
        chosen = select_quantile(probabilities, 0.0, portion)
    else:
        end, single_class = rounds.selection, rounds.single_class
        chosen = select_quasi_balanced(
            probabilities, selection=end, single_class=single_class, **over
        )
    return with_floor(probabilities, chosen, rounds.floor) if rounds.floor else chosen


def _prior(
    rounds: SelfTrainingSettings,
    probabilities: np.ndarray,
    labels: np.ndarray,
    held: tuple[np.ndarray, np.ndarray] | None,
) -> Float[np.ndarray, "k"]:
    k = probabilities.shape[1]
    if rounds.prior == "em":
        # A class that the source lacks has no share to start from; a trace lets EM find it.
        counts = np.maximum(np.bincount(labels, minlength=k), 1e-3)
        return estimate_prior_em(probabilities, counts / counts.sum())
    if held is None:
        raise InputError("prior = 'bbse' needs a held-out part of the source; set holdout above 0")
    truth, answers = held
    return estimate_prior_bbse(
        confusion_matrix(truth, answers.argmax(axis=1), k),
        np.bincount(probabilities.argmax(axis=1), minlength=k),
    )
