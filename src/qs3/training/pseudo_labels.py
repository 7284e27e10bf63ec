"""Lines 4 to 17 of Algorithm 1: select among the clouds of the target."""

import numpy as np
from jaxtyping import Bool, Float

from qs3.adaptation.selection import select_confident, select_quasi_balanced, threshold_of_share
from qs3.training.config import SelfTrainingSettings


def round_threshold(
    rounds: SelfTrainingSettings, number: int, probabilities: Float[np.ndarray, "m k"]
) -> float:
    """Return θ of a round.

    Args:
        rounds: Settings of the rounds.
        number: Count of the round, from 1.
        probabilities: Of the clouds to select from, if θ is their quantile.
    """
    if rounds.threshold_share is not None:
        share = rounds.threshold_share
        return threshold_of_share(probabilities, share, inclusive=rounds.inclusive)
    return rounds.threshold + (number - 1) * rounds.step


def select_clouds(
    probabilities: Float[np.ndarray, "m k"], theta: float, rounds: SelfTrainingSettings
) -> Bool[np.ndarray, "m"]:
    """Select clouds of a round by the rule of the settings.

    Args:
        probabilities: Of the clouds to select from.
        theta: Threshold of the round.
        rounds: Settings of the rounds.
    """
    if rounds.rule == "spst":
        return select_confident(probabilities, theta, inclusive=rounds.inclusive)
    return select_quasi_balanced(
        probabilities,
        theta,
        selection=rounds.selection,
        inclusive=rounds.inclusive,
        single_class=rounds.single_class,
    )
