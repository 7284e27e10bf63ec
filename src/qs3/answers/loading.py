"""Load the network or the forest of a run."""

from pathlib import Path
from typing import TYPE_CHECKING, Union

from qs3.clouds.preparation import ROBUST
from qs3.errors import say_once
from qs3.parts import LIBRARY
from qs3.parts.forest_file import read_forest
from qs3.parts.loaded import LoadedForest
from qs3.runs.bundled import find_run
from qs3.runs.loaded import read_measured
from qs3.runs.run import FOREST, FOREST_MODEL, SETTINGS, read_settings
from qs3.runs.settings import TrainSettings
from qs3.structure import unstructure

if TYPE_CHECKING:
    from qs3.training.predict import LoadedModel

Trained = Union["LoadedModel", LoadedForest]
"""A network or a forest, with its classes and settings."""
_EARLIER = "parts.safetensors"
"""CAD of a run of an earlier release."""


def load_trained(run: str | Path) -> Trained:
    """Load the folder of a run, a bundled network, or the file of a network or forest."""
    place = find_run(run)
    path = place if place.is_file() else place / FOREST
    if path.name != FOREST or not path.is_file():
        from qs3.training.predict import load_model  # it imports PyTorch

        return load_model(place)
    forest, facts = read_forest(path)
    settings = {"train": unstructure(TrainSettings(model=FOREST_MODEL, preparation=ROBUST))}
    if (path.parent / SETTINGS).is_file():
        settings = read_settings(path.parent)
    own, home = read_measured(facts, path), path.parent
    cad = home if (home / LIBRARY).is_file() else None
    if cad is None and (home / _EARLIER).is_file():
        say_once(f"{home}: was trained by an earlier release, and is answered without its CAD; "
                 "train it again")  # fmt: skip
    return LoadedForest(
        forest=forest, class_names=forest.class_names, settings=settings, cad=cad, **own
    )
