"""Which rule selects in a round of self-training, made from the settings."""

from collections.abc import Callable
from functools import partial

import numpy as np
from jaxtyping import Bool, Float, Int

from qs3.adaptation.priors import estimate_prior_bbse, estimate_prior_em
from qs3.adaptation.selection import (
    select_confident,
    select_prior,
    select_quantile,
    select_quasi_balanced,
    select_uniform,
)
from qs3.errors import InputError
from qs3.evaluation.metrics import confusion_matrix
from qs3.training.config import SelfTrainingSettings

Select = Callable[[Float[np.ndarray, "m k"], float], Bool[np.ndarray, "m"]]
"""A rule that selects among clouds by their probabilities and θ."""


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
