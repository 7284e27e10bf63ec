"""Which rule selects in a round of self-training, made from the settings."""

from collections.abc import Callable
from functools import partial

import numpy as np
from jaxtyping import Bool, Float

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
    settings: SelfTrainingSettings,
    number: int,
    labels: np.ndarray,
    held: Callable[[], tuple[np.ndarray, np.ndarray] | None],
) -> Select:
    """Return the rule of one round.

    Args:
        settings: Which rule, and its numbers.
        number: Count of the round, from 1.
        labels: Classes of the source's clouds, for the prior that EM starts from.
        held: Returns classes and probabilities of the held-out part of the source; asked for by
            BBSE only.
    """
    if settings.rule == "spst":
        return partial(select_confident, inclusive=settings.inclusive)
    if settings.rule == "uniform":
        return partial(select_uniform, quantile=settings.quantile, inclusive=settings.inclusive)
    if settings.rule == "quantile":
        # Rounded: 0.2 + 2 · 0.05 is a little over 0.3, which would keep one cloud more.
        portion = min(1.0, round(settings.portion + (number - 1) * settings.portion_step, 12))
        return lambda probabilities, _: select_quantile(probabilities, 0.0, portion)
    if settings.rule == "prior":
        return lambda probabilities, theta: select_prior(
            probabilities,
            theta,
            _prior(settings, probabilities, labels, held),
            quantile=settings.quantile,
            inclusive=settings.inclusive,
        )
    return partial(
        select_quasi_balanced,
        selection=settings.selection,
        inclusive=settings.inclusive,
        single_class=settings.single_class,
    )


def _prior(
    settings: SelfTrainingSettings,
    probabilities: np.ndarray,
    labels: np.ndarray,
    held: Callable[[], tuple[np.ndarray, np.ndarray] | None],
) -> Float[np.ndarray, "k"]:
    k = probabilities.shape[1]
    if settings.prior == "em":
        # A class that the source lacks has no share to start from; a trace lets EM find it.
        counts = np.maximum(np.bincount(labels, minlength=k), 1e-3)
        return estimate_prior_em(probabilities, counts / counts.sum())
    told = held()
    if told is None:
        raise InputError("prior = 'bbse' needs a held-out part of the source; set holdout above 0")
    truth, answers = told
    return estimate_prior_bbse(
        confusion_matrix(truth, answers.argmax(axis=1), k),
        np.bincount(probabilities.argmax(axis=1), minlength=k),
    )
