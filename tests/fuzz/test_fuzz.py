"""Damaged files are read, or refused in one line."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import safetensors.numpy

from qs3.errors import InputError
from qs3.evaluation.records import RECORDS, read_records
from qs3.sensor.presets import load_sensor
from qs3.store.info import info
from qs3.store.manifest import MANIFEST
from qs3.training.predict import load_model

from .attack import GOOD, attack, end_of
from .kinds import KINDS, build_generated

QUICK = ("generated", "npz", "h5", "ply", "pcd", "mesh-off", "mesh-glb", "sensor")


@pytest.mark.parametrize(
    ("kinds", "count"), [(QUICK, 80), pytest.param(tuple(KINDS), 1500, marks=pytest.mark.slow)]
)
def test_damaged_files_are_read_or_refused(
    kinds: tuple[str, ...], count: int, tmp_path: Path
) -> None:
    ends = list(attack(kinds, tmp_path, count, seed=1))
    assert [end for end in ends if end.end not in GOOD] == []
    # The damage has to matter: a loader that reads everything would not be tested at all.
    assert sum(end.end == "refused" for end in ends) > count / 5


def _manifest(folder: Path, text: str) -> Any:
    build_generated(folder / "data")
    (folder / "data" / MANIFEST).write_text(f'{{"schema": {text}}}')
    return info(folder / "data")


def _record(folder: Path, text: str) -> Any:
    (folder / RECORDS).write_text(f'{{"schema": {text}}}\n')
    records, faults = read_records(folder / RECORDS)
    if faults:
        raise InputError(faults[0])
    return records


def _weights(folder: Path, text: str) -> Any:
    path = folder / "model.safetensors"
    path.write_bytes(safetensors.numpy.save({"a": np.zeros(1)}, {"qs3": f'{{"format": {text}}}'}))
    return load_model(path)


def _sensor(folder: Path, text: str) -> Any:
    (folder / "camera.toml").write_text(f"width = {text}\n")
    return load_sensor(folder / "camera.toml")


@pytest.mark.parametrize("text", ["[" * 100_000, "9" * 5000], ids=["deep", "long"])
@pytest.mark.parametrize("act", [_manifest, _record, _weights, _sensor])
def test_json_and_toml_beyond_all_bounds_are_refused(
    tmp_path: Path, act: Callable[[Path, str], Any], text: str
) -> None:
    assert end_of(act, tmp_path, text)[0] == "refused"
