"""Confidence of a network or forest: calibration by a temperature, and *unknown* objects.

Convention:
    Probabilities are [m k], rows summing to 1; the confidence of a cloud is its largest one.
"""

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float, Int
from scipy.special import log_softmax, softmax

from qs3.adaptation.selection import check_probabilities
from qs3.checks import check_numbers
from qs3.errors import InputError

BOUNDS = (0.25, 4.0)
"""Smallest and largest temperature; a network without errors would need 0."""
_TINY = np.finfo(np.float64).tiny
_LEVELS = np.linspace(0, 1, 201)
_MOST = 1e6
"""Largest energy of logits in use; a file with a larger one is damaged."""
_DIGITS = 5
"""Decimals of the energies in files of earlier releases."""


@dataclass(frozen=True)
class Known:
    """Calibration of a network on held-out clouds of its classes."""

    temperature: float
    """Temperature that calibrates its probabilities (`fit_temperature`)."""
    energies: tuple[float, ...]
    """Evenly spaced quantiles of `energy`, from the least to the largest."""
    clouds: int
    """Held-out clouds of the source that both come from."""

    def __post_init__(self) -> None:
        energies, (low, high) = np.array(self.energies), BOUNDS
        ordered = (np.abs(energies) <= _MOST).all() and (np.diff(energies) >= 0).all()
        if not len(energies) or not ordered or not low <= self.temperature <= high:
            raise InputError(
                f"the calibration is damaged: it needs a positive temperature, {low} to {high} and "
                f"not {self.temperature}, and energies in rising order; train the run again"
            )
        if self.clouds < 1:
            raise InputError(f"the calibration is of {self.clouds} clouds; train the run again")

    def familiarity(self, logits: Float[np.ndarray, "b k"]) -> Float[np.ndarray, "b"]:
        """Return the share of the held-out clouds whose energy is below that of each cloud.

        For new clouds of the known classes it is uniform over 0 to 1: rejecting those below a share
        rejects that share of them (a conformal p-value).
        """
        values, energies = energy(logits), np.array(self.energies)
        if np.array_equal(energies, energies.round(_DIGITS)):  # of an earlier release: round both
            values = values.round(_DIGITS)
        return np.interp(values, energies, np.linspace(0, 1, len(energies)))


def energy(logits: Float[np.ndarray, "b k"]) -> Float[np.ndarray, "b"]:
    """Return log Σ exp z, higher of known objects: −E at T = 1 in Liu et al. (NeurIPS 2020), Eq. 4.

    Example:
        >>> energy(np.array([[0.0, 0.0], [5.0, 0.0]])).round(3).tolist()
        [0.693, 5.007]
    """
    return np.logaddexp.reduce(logits, axis=1)


def measure_known(logits: Float[np.ndarray, "v k"], labels: Int[np.ndarray, "v"]) -> Known:
    """Calibrate a network on held-out clouds of the source."""
    temperature = fit_temperature(softmax(logits, axis=1), labels)
    quantiles = np.quantile(energy(logits), _LEVELS)
    return Known(round(temperature, 5), tuple(quantiles.tolist()), len(labels))


def fit_temperature(probabilities: Float[np.ndarray, "v k"], labels: Int[np.ndarray, "v"]) -> float:
    """Return the temperature T that calibrates a network (Guo et al., ICML 2017, §4.2).

    It minimises the negative log likelihood of labelled clouds under softmax(z / T), z the logits,
    within `BOUNDS`. The labels are hard, so T undoes the limit that label smoothing sets to the
    confidence. The clouds must be ones that the network was not trained on.

    Example:
        Three of four right at a confidence of 0.75 is calibrated already.

        >>> rows = np.array([[0.75, 0.25]] * 4)
        >>> round(fit_temperature(rows, np.array([0, 0, 0, 1])), 4)
        1.0
    """
    from scipy.optimize import minimize_scalar  # slow to load

    check_probabilities(probabilities)
    if not len(probabilities):
        raise InputError("no held-out clouds to calibrate on")
    logits = np.log(np.maximum(probabilities, _TINY))

    def loss(inverse: float) -> float:  # convex in 1/T
        return -float(log_softmax(logits * inverse, axis=1)[np.arange(len(labels)), labels].mean())

    ends = 1 / BOUNDS[1], 1 / BOUNDS[0]
    best = minimize_scalar(loss, bounds=ends, method="bounded", options={"xatol": 1e-8})
    # The search nears an end of its range, but never tries it.
    return 1 / min((*ends, float(best.x)), key=loss)


def rescale(probabilities: Float[np.ndarray, "m k"], temperature: float) -> np.ndarray:
    """Return softmax(z / T) of softmax(z); at 1 what was given.

    Example:
        >>> rescale(np.array([[0.8, 0.2]]), 0.5).round(3).tolist()
        [[0.941, 0.059]]
    """
    check_numbers("temperature", temperature, 0, above=True)
    if temperature == 1:
        return probabilities
    return softmax(np.log(np.maximum(probabilities, _TINY)) / temperature, axis=1)
