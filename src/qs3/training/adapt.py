"""The whole way in one call: CAD models and unlabelled scans in, a classifier of the scans out."""

import logging
import operator
import warnings
from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from qs3.adaptation import method_class
from qs3.adaptation.names import split_method
from qs3.adaptation.selection import SingleClassWarning
from qs3.errors import InputError
from qs3.io import load_clouds, load_unlabelled
from qs3.io.clouds import PointClouds, RaggedClouds, UnlabelledClouds, numbered, relabel
from qs3.io.load import is_store
from qs3.io.preparation import LARGEST
from qs3.meshes import collect
from qs3.meshes.classes import canonical
from qs3.meshes.sizes import CLASS_SIZES, Unit
from qs3.processors import usable_processors
from qs3.training.batches import load_whole
from qs3.training.checkpoint import load_model
from qs3.training.classifier import Classifier, Clouds, read_paths
from qs3.training.config import (
    PRESETS,
    SelfTrainingSettings,
    TrainSettings,
    changed,
    usual_preset,
)
from qs3.training.fitting import fit
from qs3.training.rounds import remarks
from qs3.training.run import train_settings
from qs3.training.shipped import WEIGHTS, find_run
from qs3.training.validation import held_out

_LOG = logging.getLogger(__name__)
_LIKE = WEIGHTS / "rooms"
"""Network whose settings are taken, by its path, as its name could be a user's folder."""
_STEPS = 4000
"""Optimiser steps on the source: those of ``rooms``."""
_PER_CLASS = 60


def adapt(
    cad: str | Path | PointClouds,
    scans: Clouds,
    out: str | Path = "adapted",
    *,
    units: Unit | None = None,
    method: str = "qbst",
    scan: Mapping[str, Any] | None = None,
    train: Mapping[str, Any] | None = None,
    self_training: Mapping[str, Any] | None = None,
    warm_up: str | Path | None = None,
    workers: int | None = None,
    seed: int = 0,
) -> Classifier:
    """Make a classifier for a depth camera from CAD models and scans without labels.

    The models are scanned as ``qs3 generate --recipe rooms --views 1`` does, in the sizes of their
    class, or of their files if the class has no known size. A network like ``rooms`` trains on
    scans, clean twins and surfaces. Gentle rounds of QBST (QS³, Algorithm 1) adapt it. Of the
    rounds and the network before them, the one that is best on a held-out tenth of the source is
    kept (rule ``source-val``). The same call continues after a stop.

    Args:
        cad: Folder of meshes, one folder a class, or ``"shapes"`` for the built-in ones; or a data
            set of qs3 or labelled clouds, which are not scanned.
        scans: Clouds of the camera, one object each, z up, in metres. Labels are dropped.
        out: Folder for the data set (``source``) and the run (``run``).
        units: Unit of the mesh files, m, cm, mm or in; the objects then have the sizes of their
            files. None uses the sizes of the classes.
        method: One of `qs3.adaptation.names.MethodName`.
        scan: Settings of `qs3.store.generate.GenerateSettings`, such as ``{"sensor": "mine.toml"}``
            or ``{"randomise": ["rooms", "room.distance=0.3:1"]}`` for small parts.
        train: Settings of `TrainSettings` that differ from those of ``rooms``; ``rule`` "last"
            keeps the last round.
        self_training: Settings of the rounds; ``{}`` adds rounds to a method without any.
        warm_up: Run or bundled network to adapt; None trains one.
        workers: Processes that scan; None takes one a core, 0 scans in this one.
        seed: Root of all random steps.

    Raises:
        InputError: if something cannot be read, or settings do not go together.
    """
    given = dict(train or {})
    for name in ("model", "seed"):
        if name in given:
            raise InputError(f"{name} cannot be given in train here; use qs3.training.fit")
    # Faults of the settings are raised before a mesh is scanned.
    base, rule = split_method(method)
    method_class(base)
    changed(TrainSettings(), given, " in train")
    rounds = None
    if rule is not None or self_training is not None:
        rounds = _rounds(self_training or {}, rule)
    seed = operator.index(seed)
    begun = None if warm_up is None else load_model(Path(warm_up))
    target = _target(scans)
    source = _source(cad, Path(out) / "source", units, scan or {}, workers, seed)
    if begun is None or warm_up is None:
        settings = _settings_like_rooms(source, given, seed)
    else:
        source = relabel(source, begun.class_names, None, "source")
        own = replace(train_settings(Path(warm_up)), seed=seed)
        settings = changed(own, given, " in train")
    with warnings.catch_warnings():  # `remarks` names them
        warnings.simplefilter("ignore", SingleClassWarning)
        before = None if warm_up is None else find_run(warm_up)
        done = fit(
            method, source, target, settings, rounds, run_dir=Path(out) / "run", warm_up=before
        )
    if rounds is not None:
        for line in remarks(done.rounds, rounds, source.class_names, "threshold_share"):
            _LOG.warning(line)
    return Classifier.load(Path(out) / "run")


def _settings_like_rooms(source: PointClouds, given: Mapping[str, Any], seed: int) -> TrainSettings:
    like = replace(train_settings(_LIKE), seed=seed)
    batches = max(1, len(source) // int(given.get("batch_size", like.batch_size)))
    chosen = {"epochs": max(1, round(_STEPS / batches))} | dict(given)
    if "rule" not in given:
        # By the source alone, if a class has enough clouds for a part to be held out.
        if held_out(source, TrainSettings(holdout=given.get("holdout", like.holdout))).any():
            chosen["rule"] = "source-val"
        else:
            _LOG.warning("no class has clouds enough to hold some out: the last round is kept")
    if chosen.get("rule", like.rule) != "last":
        chosen.setdefault("validate_every", chosen["epochs"])
    return changed(like, chosen, " in train")


def _rounds(given: Mapping[str, Any], rule: str | None) -> SelfTrainingSettings:
    given = ({} if rule is None else {"rule": rule}) | dict(given)
    return changed(PRESETS[usual_preset(given.get("rule"))], given, " in self_training")


def _source(
    cad: str | Path | PointClouds,
    folder: Path,
    units: Unit | None,
    scan: Mapping[str, Any],
    workers: int | None,
    seed: int,
) -> PointClouds:
    from qs3.store.failures import FAILURES, read_failures
    from qs3.store.generate import generate
    from qs3.store.scan_item import RECIPES, settings_for

    scanned = not isinstance(cad, PointClouds) and not is_store(cad)
    if (units is not None or scan) and not scanned:
        what = f"units {units}" if units is not None else f"scan {', '.join(scan)}"
        raise InputError(f"{what}: goes with a folder of meshes alone")
    if "seed" in scan or "units" in scan:
        raise InputError("scan: seed and units are given beside it")
    if isinstance(cad, PointClouds):
        return cad
    if scanned:
        items = collect(cad, per_class=_PER_CLASS, seed=seed)
        have_sizes = {canonical(item.class_name) for item in items} <= {*CLASS_SIZES}
        size = "class" if have_sizes and units is None else "file"
        recipe = replace(RECIPES["rooms"], views=1, seed=seed, object_size=size, units=units)
        recipe = settings_for(changed(recipe, scan, " in scan"), items, [cad], _PER_CLASS)
        generate(items, folder, recipe, workers=usable_processors() if workers is None else workers)
        failed = read_failures(folder)
        if failed:
            many = f"{len(failed)} of {recipe.scans_per_mesh * len(items)} scans failed"
            first = f"{failed[0]['id']}: {failed[0]['reason']}"
            _LOG.warning(f"{many}, told in {folder / FAILURES}; the first, {first}")
        cad = folder
    return load_clouds(cad, num_points=None, cloud="all")


def _target(scans: Clouds) -> UnlabelledClouds:
    if isinstance(scans, UnlabelledClouds):
        return scans
    if isinstance(scans, PointClouds):
        return scans.without_labels()
    if isinstance(scans, str | Path):
        settings = train_settings(_LIKE)
        return load_whole(load_unlabelled, scans, settings.num_points, settings.preparation)
    read, floor = read_paths(scans)
    clouds = [np.asarray(cloud, np.float32) for cloud in read]
    if any(cloud.ndim != 2 or cloud.shape[1:] != (3,) for cloud in clouds):
        raise InputError("scans: give clouds of shape [n 3], several of them")
    return RaggedClouds(clouds, numbered(len(clouds)), "", floor=floor).unlabelled(
        None, "scans", LARGEST
    )
