"""Let a trained network learn from a few labelled scans: it stays frozen, a small head is added."""

from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
from jaxtyping import Float, Int
from scipy.optimize import minimize
from scipy.special import log_softmax

from qs3.clouds.types import PointClouds
from qs3.errors import InputError
from qs3.models.wrappers import Corrected
from qs3.runs.checks import require_labelled
from qs3.runs.digests import checksums, fingerprint, shapes
from qs3.runs.history import EpochRecord, stopwatch
from qs3.runs.loaded import Loaded, facts_of
from qs3.runs.run import FEW_LABEL, HEAD, Run, RunSettings, claim_run, read_run, sum_cost, write_run
from qs3.runs.settings import TrainSettings
from qs3.runs.weights import save_model, weights_fingerprint
from qs3.structure import structure
from qs3.training.predict import load_model
from qs3.training.prepared import prepare_clouds

DECAY, BIAS_DECAY = 0.3, 3.0
"""Weight decay of the head: with 50 labels best in accuracy and class mean on NYU's strict-dev."""


class HeadPlan(NamedTuple):
    """A head that is to be trained."""

    loaded: Loaded
    """The network."""
    before: Run
    wanted: RunSettings


def plan_head(network: Path, labelled: PointClouds) -> HeadPlan:
    """Check all that `train_head` is given, but its folder."""
    loaded, before = load_model(network), read_run(network)
    names = loaded.class_names
    if before.method.startswith(FEW_LABEL):
        raise InputError(f"{network}: is {before.method} itself; name the network before it")
    if labelled.class_names != names:
        raise InputError(f"labels are of other classes than {network}: {', '.join(names)}")
    require_labelled(labelled, loaded.preparation, loaded.sizes)
    settings = structure(loaded.settings["train"], TrainSettings, network)
    weights, labels = weights_fingerprint(loaded.model), fingerprint(labelled)
    return HeadPlan(
        loaded, before, RunSettings(HEAD, settings, names, warm_up=weights, labels=labels)
    )


def train_head(network: Path, labelled: PointClouds, *, run_dir: Path) -> Run:
    """Add a head to a trained network, fitted to a few labelled scans.

    The head is a linear map of the pooled features. Its output is added to the network's logits;
    the network does not change. The record has the method ``few-label-head``, never that of a
    label-free run.

    Args:
        network: Finished run of a network that has not learnt from labelled scans, or a bundled
            network.
        labelled: A few labelled scans of its classes.
        run_dir: Folder of the new run.
    """
    spent = stopwatch()
    loaded, before, wanted = plan_head(network, labelled)
    names, settings = wanted.class_names, wanted.train
    with claim_run(run_dir, wanted):
        description = loaded.describe(labelled.points)
        weight, bias = fit_correction(description.features, description.logits, labelled.labels)
        model = Corrected(loaded.model, len(names)).eval()
        with torch.no_grad():
            model.correction.weight.copy_(torch.from_numpy(weight.T))
            model.correction.bias.copy_(torch.from_numpy(bias))
        facts = facts_of(replace(loaded, known=None))
        save_model(run_dir, model, names, settings, facts=facts)
        seen = prepare_clouds(labelled, settings.num_points, settings.preparation)
        cost = sum_cost([EpochRecord(0, {}, 0.0, **spent())], [])
        if before.cpu_seconds:
            cost["cpu_seconds"] |= {"warm-up": before.cpu_seconds["total"]}
        run = replace(
            before,
            method=HEAD,
            selection="last",
            chosen={"stage": HEAD, "number": 1},
            source_clouds=tuple(sorted({*before.source_clouds, *checksums(seen)})),
            source_shapes=tuple(sorted({*before.source_shapes, *shapes(labelled.points)})),
            rounds=(),
            preset=None,
            threads=1,
            folder=run_dir,
            **cost,
        )
        write_run(run)
    return run


def fit_correction(
    features: Float[np.ndarray, "b c"],
    logits: Float[np.ndarray, "b k"],
    labels: Int[np.ndarray, "b"],
) -> tuple[Float[np.ndarray, "c k"], Float[np.ndarray, "k"]]:
    """Return the linear map of the features that mends the logits: a regression with decay.

    It minimises the cross entropy plus `DECAY` and `BIAS_DECAY` on features that are centred and
    scaled to a mean square of 1. A cloud weighs as the inverse root of its class's count, halfway
    between equal clouds and equal classes. The problem is convex: no seed, one answer.
    """
    (rows, width), classes = features.shape, logits.shape[1]
    mean = features.mean(axis=0)
    scale = float(np.sqrt(((features - mean) ** 2).sum(axis=1).mean())) or 1.0
    inputs = (features - mean) / scale
    shares = 1 / np.sqrt(np.bincount(labels, minlength=classes)[labels])
    shares, hot = shares * (rows / shares.sum()), np.eye(classes)[labels]

    def loss(flat: np.ndarray) -> tuple[float, np.ndarray]:
        weight, bias = flat[:-classes].reshape(width, classes), flat[-classes:]
        logs = log_softmax(logits + inputs @ weight + bias, axis=1)
        slope = (np.exp(logs) - hot) * shares[:, None]
        decay = DECAY * (weight**2).sum() + BIAS_DECAY * (bias**2).sum()
        value = float(-(shares[:, None] * hot * logs).sum() + decay / 2)
        slopes = inputs.T @ slope + DECAY * weight, slope.sum(axis=0) + BIAS_DECAY * bias
        return value, np.concatenate([part.ravel() for part in slopes])

    start = np.zeros((width + 1) * classes)
    flat = minimize(loss, start, jac=True, method="L-BFGS-B", options={"maxiter": 300}).x
    weight, bias = flat[:-classes].reshape(width, classes) / scale, flat[-classes:]
    return weight, bias - mean @ weight
