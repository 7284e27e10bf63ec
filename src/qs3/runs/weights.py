"""Weights and states as safetensors with JSON, which are never unpickled; seeds."""

import hashlib
import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
import safetensors.torch
import torch
from torch import Tensor, nn

from qs3.clouds.preparation import Preparation
from qs3.errors import InputError
from qs3.files import open_arrays, write_bytes
from qs3.models import PointClassifier, create_model
from qs3.models.wrappers import Aligned, Corrected, Sized
from qs3.reading import reading
from qs3.runs.device import seeded
from qs3.runs.history import EpochRecord
from qs3.runs.run import MODEL
from qs3.runs.settings import TrainSettings
from qs3.structure import unstructure

FORMAT = 1
CHECKPOINT = "checkpoint.safetensors"
"""State of a training in progress."""


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
    with open_arrays(path) as (_, facts):
        if not isinstance(facts, dict):
            raise InputError("its metadata are damaged")
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
    """Return the tensors under ``prefix/``, without it."""
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
        >>> len({derived_seed(*path) for path in [(0, 0), (0, 1), (1, 0), (0, 1, 0)]})
        4
    """
    return int(seed_sequence(seed, *path).generate_state(1, np.uint64)[0] >> np.uint64(1))


def new_model(settings: TrainSettings, num_classes: int, seed: int) -> PointClassifier:
    """Make the network of the settings with weights drawn from ``seed`` alone."""
    with seeded(seed):
        return build(settings.model, num_classes, settings.model_settings, settings.preparation)


def build(
    name: str,
    num_classes: int,
    arguments: Mapping[str, Any],
    preparation: Preparation,
    head: bool = False,
) -> PointClassifier:
    """Make a network with the wrappers of its preparation, and of a few-label head if any."""
    model = create_model(name, num_classes, **arguments)
    model = Aligned(model) if preparation.align else model
    model = Sized(model, preparation.radius_share) if preparation.size_input else model
    return Corrected(model, num_classes) if head else model


def save_model(
    run_dir: Path,
    model: PointClassifier,
    class_names: Sequence[str],
    settings: TrainSettings,
    *,
    name: str = MODEL,
    facts: Mapping[str, Any] | None = None,
) -> Path:
    """Write the weights to a file in a run's folder, and return it.

    The file alone is enough to rebuild the network. ``facts`` are further metadata, such as
    `qs3.runs.loaded.facts_of`.
    """
    path = Path(run_dir) / name
    described = {
        "format": FORMAT,
        "class_names": list(class_names),
        "model": settings.model,
        "model_settings": dict(settings.model_settings),
        "num_points": settings.num_points,
        "preparation": unstructure(settings.preparation),
    }
    described |= {"head": True} if isinstance(model, Corrected) else {}
    write_tensors(path, model.state_dict(), {**(facts or {}), **described})
    return path


def weights_fingerprint(model: PointClassifier) -> str:
    """SHA-256 over names and values of a network's weights, by which a warm-up is known."""
    digest = hashlib.sha256()
    for name, tensor in sorted(model.state_dict().items()):
        digest.update(name.encode())
        digest.update(tensor.detach().cpu().contiguous().numpy().tobytes())
    return digest.hexdigest()


@torch.no_grad()
def follow(average: nn.Module, student: nn.Module, decay: float) -> None:
    """Move an average by 1 − decay towards a network; integers are copied."""
    present = student.state_dict()
    for name, tensor in average.state_dict().items():
        if tensor.is_floating_point():
            tensor.lerp_(present[name], 1.0 - decay)
        else:
            tensor.copy_(present[name])


def write_state(
    folder: Path,
    modules: Mapping[str, nn.Module],
    optimiser: torch.optim.Optimizer,
    stream: tuple[int, ...],
    history: Sequence[EpochRecord],
) -> None:
    """Write a training's state after an epoch; ``stream`` numbers its random draws."""
    tensors = prefixed("optimiser", optimiser_tensors(optimiser))
    for name, module in modules.items():
        tensors |= prefixed(name, module.state_dict())
    records = [asdict(record) for record in history]
    facts = {"stream": list(stream), "history": records}
    write_tensors(folder / CHECKPOINT, tensors, facts)


def read_state(
    folder: Path,
    modules: Mapping[str, nn.Module],
    optimiser: torch.optim.Optimizer,
    stream: tuple[int, ...],
) -> list[EpochRecord]:
    """Load the state of `write_state`, and return the finished epochs; none of another stream."""
    path = folder / CHECKPOINT
    if not path.is_file():
        return []
    tensors, facts = read_tensors(path)
    try:
        if facts["stream"] != list(stream):
            return []
        history = [EpochRecord(**record) for record in facts["history"]]
        load_optimiser(optimiser, without_prefix("optimiser", tensors))
        for name, module in modules.items():
            load_tensors_into(module, without_prefix(name, tensors), path)
    except (KeyError, TypeError) as error:
        raise InputError(f"{path}: not a checkpoint of this version; delete it") from error
    return history
