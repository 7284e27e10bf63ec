"""A trained network in place of the training before the rounds."""

import logging
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool

from qs3.clouds.types import PointClouds
from qs3.errors import InputError
from qs3.models.wrappers import Corrected
from qs3.runs.bundled import find_run
from qs3.runs.digests import fingerprint
from qs3.runs.overlap import caveats
from qs3.runs.run import RUN, Run, read_run
from qs3.runs.settings import TrainSettings
from qs3.structure import first_difference, unstructure
from qs3.training.predict import LoadedModel, load_model
from qs3.training.prepared import prepare_clouds

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
        """Read the folder of a run, a file of weights, or a bundled network."""
        folder = find_run(path)
        run = read_run(folder) if (folder / RUN).is_file() else None
        return cls(folder, load_model(folder), run)

    def require_same(self, base: str, source: PointClouds, settings: TrainSettings) -> None:
        """Raise InputError if its classes, network or method are not those of the training."""
        its, names = self.loaded.settings, self.loaded.class_names
        trained, ours = its["train"], unstructure(settings)
        same = ["model", "model_settings", "num_points", "preparation"]
        same += ["method_settings"] if "method_settings" in trained else []
        old, new = ({name: each.get(name) for name in same} for each in (trained, ours))
        difference = first_difference(old, new)
        method, fault = its.get("method", base), ""
        if names != source.class_names:
            fault = f"its classes ({', '.join(names)}) are not those of the source"
        elif difference:
            name, old, new = difference
            fault = f"trained with {name} = {old!r}, not {new!r}; use the same setting"
        elif its.get("self_training") is not None:
            fault = "is self-trained itself; name the run before its rounds"
        elif method != base:
            fault = f"is a run of method {method}, not {base}; add self-training to method {method}"
        elif isinstance(self.loaded.model, Corrected):
            fault = "learnt from labelled scans; name the network before its head"
        if fault:
            raise InputError(f"{self.folder}: {fault}")

    def has_not_seen(
        self, source: PointClouds, held: Bool[np.ndarray, "b"], settings: TrainSettings
    ) -> bool:
        """Return whether it held out the same part of the source, or has not seen that part."""
        its = self.loaded.settings
        trained = its["train"]
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

    def add_to(self, run: Run, source_clouds: int) -> Run:
        """Add its data, for the marks of the scores, and its cost to the record of a run."""
        before = self.run
        if before is None:
            return replace(run, unknown_warm_up=True)
        added: dict[str, Any] = {} if source_clouds else {"source": before.source}
        for name in ("source_clouds", "target_clouds", "source_shapes", "target_shapes"):
            added[name] = tuple(sorted({*getattr(run, name), *getattr(before, name)}))
        for name in ("cpu_seconds", "steps"):
            if spent := getattr(before, name):
                added[name] = getattr(run, name) | {"warm-up": spent["total"]}
        added["supervised"] = run.supervised or before.supervised
        return replace(run, **added, unknown_warm_up=before.unknown_warm_up)
