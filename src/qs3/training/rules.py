"""Which rule selects in a round of self-training, made from the settings."""

from collections.abc import Callable
from functools import partial

import numpy as np
from jaxtyping import Bool, Float, Int

from qs3.adaptation.confidence import threshold_of_share
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

Select = Callable[[Float[np.ndarray, "m k"], float], Bool[np.ndarray, "m"]]
"""A rule that selects among clouds by their probabilities and θ."""


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


def make_rule(
    rounds: SelfTrainingSettings,
    number: int,
    labels: Int[np.ndarray, "s"],
    held: tuple[np.ndarray, np.ndarray] | None,
) -> Select:
    """Return the rule that selects in one round.

    Args:
        rounds: Which rule, and its numbers.
        number: Count of the round, from 1.
        labels: Classes of the source's clouds, for the prior that EM starts from.
        held: Classes and probabilities of the held-out part of the source, for BBSE.

    Raises:
        InputError: where BBSE has no held-out part.
    """
    rule = _plain_rule(rounds, number, labels, held)
    if not rounds.floor:
        return rule
    return lambda probabilities, theta: with_floor(
        probabilities, rule(probabilities, theta), rounds.floor
    )


def _plain_rule(
    rounds: SelfTrainingSettings,
    number: int,
    labels: Int[np.ndarray, "s"],
    held: tuple[np.ndarray, np.ndarray] | None,
) -> Select:
    """Return the rule without its floor."""
    if rounds.rule == "spst":
        return partial(select_confident, inclusive=rounds.inclusive)
    if rounds.rule == "uniform":
        return partial(select_uniform, quantile=rounds.quantile, inclusive=rounds.inclusive)
    if rounds.rule == "quantile":
        # Rounded: 0.2 + 2 · 0.05 is a little over 0.3, which would keep one cloud more.
        portion = min(1.0, round(rounds.portion + (number - 1) * rounds.portion_step, 12))
        return lambda probabilities, _: select_quantile(probabilities, 0.0, portion)
    if rounds.rule == "prior":
        return lambda probabilities, theta: select_prior(
            probabilities,
            theta,
            _prior(rounds, probabilities, labels, held),
            quantile=rounds.quantile,
            inclusive=rounds.inclusive,
        )
    return partial(
        select_quasi_balanced,
        selection=rounds.selection,
        inclusive=rounds.inclusive,
        single_class=rounds.single_class,
    )


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
