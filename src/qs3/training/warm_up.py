"""A trained network that rounds of self-training start from."""

import logging
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool

from qs3.errors import InputError
from qs3.io.clouds import PointClouds
from qs3.structure import first_difference, unstructure
from qs3.training.checkpoint import LoadedModel, load_model
from qs3.training.config import SelfTrainingSettings, TrainSettings
from qs3.training.overlap import caveats
from qs3.training.prepared import prepare_clouds
from qs3.training.run import RUN, Run, fingerprint, read_run
from qs3.training.shipped import find_run

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class WarmUp:
    """A trained network that the rounds start from."""

    folder: Path
    loaded: LoadedModel
    run: Run | None
    """Its run; None if it is weights alone."""

    @classmethod
    def read(cls, path: Path) -> "WarmUp":
        """Read a finished run, or weights alone.

        Raises:
            InputError: if it cannot be read.
        """
        folder = find_run(path)
        run = read_run(folder) if (folder / RUN).is_file() else None
        return cls(folder, load_model(folder), run)

    def require_same(self, base: str, source: PointClouds, settings: TrainSettings) -> None:
        """Raise InputError if its classes, network or method are not those of the training."""
        class_names, its = self.loaded.class_names, self.loaded.settings
        if class_names != source.class_names:
            raise InputError(
                f"{self.folder}: its classes ({', '.join(class_names)}) are not those of the "
                f"source ({', '.join(source.class_names)})"
            )
        ours, trained = unstructure(settings), its.get("train", {})
        names = ["model", "model_settings", "num_points", "preparation"]
        names += ["method_settings"] if "method_settings" in trained else []
        theirs, wanted = ({name: each.get(name) for name in names} for each in (trained, ours))
        if difference := first_difference(theirs, wanted):
            name, old, new = difference
            raise InputError(
                f"{self.folder}: trained with {name} = {old!r}, not {new!r}; use the same setting"
            )
        if its.get("self_training") is not None:
            raise InputError(
                f"{self.folder}: is self-trained itself; name the run before its rounds"
            )
        method = its.get("method", base)
        if method != base:
            raise InputError(
                f"{self.folder}: is a run of method {method}, not {base}; choose method {method} "
                "with self-training after it"
            )

    def has_not_seen(
        self, source: PointClouds, held: Bool[np.ndarray, "b"], settings: TrainSettings
    ) -> bool:
        """Whether it held out the same part of the source, or has seen none of its clouds."""
        its = self.loaded.settings
        trained = its.get("train", {})
        same = all(trained.get(name) == getattr(settings, name) for name in ("seed", "holdout"))
        if same and its.get("source") == fingerprint(source):
            return True
        part = prepare_clouds(source.select(held), settings.num_points, settings.preparation)
        seen = {"training clouds", "transductive"}
        if self.run is not None and not seen & {*caveats(self.run, part)}:
            return not self.run.unknown_warm_up
        _LOG.warning(
            "%s: was trained on another part of the source, so that none of it is left to validate "
            "on; same source, seed and holdout would leave one",
            self.folder,
        )
        return False


def no_clouds(given: WarmUp | None, rounds: SelfTrainingSettings | None) -> PointClouds:
    """Return an empty source of the warm-up's classes."""
    if given is None or rounds is None:
        raise InputError("without a source there is nothing to train on; give labelled clouds")
    if rounds.source_loss:
        raise InputError(
            "source_loss needs labelled clouds of the source; give some, or leave it out"
        )
    names = given.loaded.class_names
    return PointClouds(np.zeros((0, 1, 3), np.float32), np.zeros(0, np.int64), names, ())


def with_warm_up(run: Run, before: Run) -> Run:
    """Add what the network has seen in its warm-up, for the marks of its scores, and its cost."""
    names = ("source_clouds", "target_clouds")
    both: dict[str, Any] = {
        name: tuple(sorted({*getattr(run, name), *getattr(before, name)})) for name in names
    }
    for name in ("cpu_seconds", "steps"):
        if spent := getattr(before, name):
            both[name] = getattr(run, name) | {"warm-up": spent["total"]}
    supervised = run.supervised or before.supervised
    return replace(run, **both, supervised=supervised, unknown_warm_up=before.unknown_warm_up)
