"""Weights as safetensors with JSON: nothing is ever unpickled; and the seeds of all draws."""

import hashlib
import json
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import safetensors
import safetensors.torch
import torch
from jaxtyping import Float
from torch import Tensor, nn

from qs3.errors import InputError
from qs3.files import parse_json, write_bytes
from qs3.io.preparation import PAPER, Preparation
from qs3.meshes.classes import check_class_names
from qs3.models import PointClassifier, create_model
from qs3.models.aligned import Aligned
from qs3.models.corrected import Corrected
from qs3.models.sized import Sized
from qs3.reading import naming, reading
from qs3.structure import structure, unstructure
from qs3.training.config import TrainSettings
from qs3.training.run import FOREST, MODEL, SETTINGS, read_settings
from qs3.training.shipped import find_run, not_a_run
from qs3.training.trained import Description, Loaded, read_measured

FORMAT = 1


@dataclass(frozen=True, kw_only=True)
class LoadedModel(Loaded):
    """A network read from a run."""

    model: PointClassifier
    """The trained network, in evaluation mode, on the CPU."""
    preparation: Preparation = PAPER

    @property
    def num_points(self) -> int | None:
        """Return points a cloud; None if unknown."""
        return self.settings["train"].get("num_points")

    def ask(
        self, points: Float[np.ndarray, "b n 3"], floor: Float[np.ndarray, "b"] | None = None
    ) -> Description:
        """Return the network's description of clouds as read; ``floor`` is z of each floor."""
        from qs3.training.predict import ask

        return ask(self, points).at_height(self.heights, points, floor)


def write_tensors(path: Path, tensors: Mapping[str, Tensor], facts: Mapping[str, Any]) -> None:
    """Write named tensors and JSON facts to one safetensors file, atomically."""
    # Copies: safetensors refuses tensors that share memory.
    plain = {name: t.detach().cpu().clone().contiguous() for name, t in tensors.items()}
    metadata = {"qs3": json.dumps(facts, allow_nan=False)}
    write_bytes(path, safetensors.torch.save(plain, metadata))


def read_tensors(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Read what `write_tensors` wrote."""
    facts = read_facts(path)
    with reading(path, "safetensors"):
        return safetensors.torch.load_file(path), facts


def read_facts(path: Path) -> dict[str, Any]:
    """Read the facts of `read_tensors` alone; the tensors stay on disk."""
    path = Path(path)
    try:
        with (
            reading(path, "safetensors"),
            safetensors.safe_open(path, framework="pt") as handle,  # pyright: ignore[reportPrivateImportUsage]
        ):
            facts = parse_json((handle.metadata() or {})["qs3"], path)
    except InputError as error:
        reason = str(error).removeprefix(f"{path}: ")
        raise InputError(f"{path}: not a safetensors file of qs3 ({reason})") from error
    if not isinstance(facts, dict):
        raise InputError(f"{path}: not a safetensors file of qs3 (its metadata are damaged)")
    return facts


def load_tensors_into(module: nn.Module, tensors: Mapping[str, Tensor], where: Path) -> None:
    """Set a module's parameters and buffers; raises InputError if one is not finite."""
    for name, tensor in tensors.items():
        if tensor.is_floating_point() and not tensor.isfinite().all():
            raise InputError(f"{where}: weights are not finite ({name}); train again")
    try:
        module.load_state_dict(dict(tensors), strict=True)
    except RuntimeError as error:
        reason = " ".join(str(error).split())[:200]
        raise InputError(f"{where}: weights are of another network ({reason})") from error


def optimiser_tensors(optimiser: torch.optim.Optimizer) -> dict[str, Tensor]:
    """Flatten an optimiser's state to tensors named ``<index of parameter>.<name>``."""
    state = optimiser.state_dict()["state"]
    return {f"{i}.{name}": torch.as_tensor(v) for i, s in state.items() for name, v in s.items()}


def load_optimiser(optimiser: torch.optim.Optimizer, tensors: Mapping[str, Tensor]) -> None:
    """Set an optimiser's state from `optimiser_tensors`."""
    state: dict[int, dict[str, Tensor]] = {}
    for key, value in tensors.items():
        index, name = key.split(".", 1)
        state.setdefault(int(index), {})[name] = value
    groups = optimiser.state_dict()["param_groups"]
    optimiser.load_state_dict({"state": state, "param_groups": groups})


def prefixed(prefix: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Put ``prefix/`` before every name."""
    return {f"{prefix}/{name}": value for name, value in tensors.items()}


def without_prefix(prefix: str, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
    """Return the tensors under ``prefix/``, without it.

    Example:
        >>> without_prefix("a", prefixed("a", {"x": torch.zeros(1)}))
        {'x': tensor([0.])}
    """
    start = f"{prefix}/"
    return {name[len(start) :]: v for name, v in tensors.items() if name.startswith(start)}


def seed_sequence(seed: int, *path: int) -> np.random.SeedSequence:
    """Return random bits that depend on the root seed and on every number of ``path``.

    The path is a spawn key: as plain entropy, a zero at its end would make no difference.
    """
    return np.random.SeedSequence(seed, spawn_key=path)


def derived_seed(seed: int, *path: int) -> int:
    """Return a seed for PyTorch, as `seed_sequence`.

    Example:
        >>> derived_seed(0, 1) == derived_seed(0, 2)
        False
    """
    return int(seed_sequence(seed, *path).generate_state(1, np.uint64)[0] >> np.uint64(1))


def new_model(settings: TrainSettings, num_classes: int, seed: int) -> PointClassifier:
    """Make the network of the settings with weights drawn from ``seed`` alone."""
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(seed)
        return _make(settings.model, num_classes, settings.model_settings, settings.preparation)


def _make(
    name: str, num_classes: int, arguments: Mapping[str, Any], preparation: Preparation
) -> PointClassifier:
    model = create_model(name, num_classes, **arguments)
    model = Aligned(model) if preparation.align else model
    return Sized(model, preparation.radius_share) if preparation.size_input else model


def _check_shapes(
    name: str,
    num_classes: int,
    arguments: Mapping[str, Any],
    tensors: Mapping[str, Tensor],
    where: Path,
    wrappers: int,
) -> None:
    """Refuse weights that do not fit the network, before memory is allocated."""
    try:
        with torch.device("meta"):
            wanted = create_model(name, num_classes, **arguments).state_dict()
    except (RuntimeError, OverflowError) as error:  # sizes beyond any number
        raise InputError(f"{where}: weights are of another network ({error})") from error
    inside = "model." * wrappers
    for key, tensor in wanted.items():
        held = tensors.get(f"{inside}{key}")
        if held is None or held.shape != tensor.shape:
            size = "is missing" if held is None else f"is {list(held.shape)}"
            raise InputError(
                f"{where}: weights are of another network ({inside}{key} {size}, the settings of "
                f"{name} want {list(tensor.shape)})"
            )


def save_model(
    run_dir: Path,
    model: PointClassifier,
    class_names: tuple[str, ...],
    settings: TrainSettings,
    *,
    name: str = MODEL,
    facts: Mapping[str, Any] | None = None,
) -> Path:
    """Write the weights to a file in a run's folder, and return it.

    The file alone is enough to rebuild the network. ``facts`` are further metadata, such as
    `qs3.training.trained.facts_of`.
    """
    path = Path(run_dir) / name
    own = {
        "format": FORMAT,
        "class_names": list(class_names),
        "model": settings.model,
        "model_settings": dict(settings.model_settings),
        "num_points": settings.num_points,
        "preparation": unstructure(settings.preparation),
    }
    own |= {"head": True} if isinstance(model, Corrected) else {}
    write_tensors(path, model.state_dict(), {**(facts or {}), **own})
    return path


def load_model(run_dir: Path) -> LoadedModel:
    """Read the network of a run.

    Args:
        run_dir: Folder of the run, a bundled network, or a ``.safetensors`` file that `save_model`
            wrote. Without ``settings.json`` next to it, the settings hold what the file contains,
            under ``train``.
    """
    run_dir = find_run(run_dir)
    path = run_dir if run_dir.is_file() else run_dir / MODEL
    if path.name == FOREST or (run_dir / FOREST).is_file():
        raise InputError(f"{run_dir}: holds a forest, and this takes a network only")
    if not path.is_file():
        state = "the run is not finished" if (run_dir / SETTINGS).is_file() else not_a_run()
        raise InputError(f"{run_dir}: no {MODEL} here; {state}")
    tensors, facts = read_tensors(path)
    try:
        if facts["format"] != FORMAT:
            raise InputError(f"{path}: format {facts['format']}, this version reads {FORMAT}")
        with naming(path):
            class_names = check_class_names(facts["class_names"])
        name, arguments = facts["model"], dict(facts["model_settings"])
        preparation = structure(facts.get("preparation", {}), Preparation, path)
        own = read_measured(facts, len(class_names), path)
        with torch.random.fork_rng(devices=[]):
            has_head = facts.get("head") is True
            wrappers = preparation.align + preparation.size_input + has_head
            _check_shapes(name, len(class_names), arguments, tensors, path, wrappers)
            model = _make(name, len(class_names), arguments, preparation)
            model = Corrected(model, len(class_names)) if has_head else model
    except (KeyError, TypeError) as error:
        raise InputError(f"{path}: does not say which network it holds ({error})") from error
    load_tensors_into(model, tensors, path)
    if (path.parent / SETTINGS).is_file():
        settings = read_settings(path.parent)
    else:
        kept = ("model", "model_settings", "num_points", "preparation")
        settings = {"train": {key: facts[key] for key in kept if key in facts}}
        structure(settings["train"], TrainSettings, path)  # refuses what is none
    own |= {"class_names": class_names, "settings": settings, "preparation": preparation}
    return LoadedModel(model=model.eval(), **own)


def weights_fingerprint(model: PointClassifier) -> str:
    """SHA-256 over names and values of a network's weights, by which a warm-up is known."""
    digest = hashlib.sha256()
    for name, tensor in sorted(model.state_dict().items()):
        digest.update(name.encode())
        digest.update(tensor.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()
