"""The files beside the shards: ``dataset.json``, checksums of the meshes, scans that failed.

They say which shards are finished, so that the same call resumes; one call at a time holds
the lock.
"""

import contextlib
import functools
import hashlib
import json
import platform
import warnings
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from qs3.errors import FailedScansError, InputError
from qs3.files import (
    claim_folder,
    folder_lock,
    parse_json,
    read_json,
    remove_left_overs,
    sha256,
    state_of,
    write_json,
    write_text,
)
from qs3.meshes.classes import check_class_names
from qs3.meshes.trees import mesh_files
from qs3.structure import first_difference, structure, unstructure

MANIFEST = "dataset.json"
MESHES = "meshes.json"
FAILURES = "failures.jsonl"
"""The log of scans that failed, one record per line."""
SCHEMA_VERSION = 3
_PACKAGES = (
    *("qs3", "mitsuba", "numpy", "opencv-python-headless"),
    *("pyarrow", "scipy", "torch", "trimesh"),
)


@dataclass(frozen=True)
class Manifest:
    """Contents of ``dataset.json``."""

    settings: Mapping[str, Any]
    """Every setting that the rows depend on, as plain values."""
    class_names: tuple[str, ...]
    rows: int | None
    """Rows planned (failed objects are absent); None if only the extraction can count them."""
    shards: int
    versions: Mapping[str, str]
    renamed: Mapping[str, str] = field(default_factory=dict)
    """Classes of the meshes that have another name here; not in the file if empty."""
    schema: int = SCHEMA_VERSION

    def __post_init__(self) -> None:
        check_class_names(self.class_names)


@dataclass(frozen=True)
class Report:
    """Counts of one call of ``generate`` (scans) or ``merge`` (shards)."""

    done: int
    skipped: int
    failed: int
    """Scans that failed: in this call of ``generate``, or in all merged parts."""


def package_versions(*more: str) -> dict[str, str]:
    """Return the versions of Python and of the packages that a result depends on, by name."""
    versions = {"python": platform.python_version()}
    for name in (*_PACKAGES, *more):
        with contextlib.suppress(PackageNotFoundError):
            versions[name] = version(name)
    return versions


@contextlib.contextmanager
def claimed(folder: Path) -> Iterator[None]:
    """Make the folder of a data set, or accept one of ours, and keep other processes out of it."""
    claim_folder(folder, MANIFEST)
    with folder_lock(folder):
        remove_left_overs(folder)
        yield


def write_manifest(folder: Path, manifest: Manifest) -> None:
    """Write ``dataset.json``, or accept the existing one if its settings are the same."""
    if (folder / MANIFEST).is_file():
        check_same(folder, open_dataset(folder), manifest)
        return
    value = unstructure(manifest)
    if not manifest.renamed:
        del value["renamed"]
    write_json(folder / MANIFEST, value)


def check_same(folder: Path, present: Manifest, wanted: Manifest) -> None:
    """Refuse a data set of other settings than those wanted; warn if versions differ."""
    old, new = unstructure(present), unstructure(wanted)
    # Labels: what was measured, and the work list, stand beside them. Before grids there was none.
    for value in (old, new):
        value["settings"] = {"grid": None, **value["settings"], "like": "", "meshes": ""}
        value["sensor"] = value["settings"].pop("sensor", None)  # others follow from it
    for key in ("schema", "sensor", "settings", "class_names", "rows", "shards"):
        difference = first_difference(old[key], new[key], key)
        if difference is not None:
            name, was, now = difference
            cause = f"made with {name.removeprefix('settings.')} = {was}, not {now}"
            if key == "settings" and name.split(".")[1] not in old[key]:
                raise InputError(
                    f"{folder}: an earlier version of qs3 made it, without "
                    f"{name.removeprefix('settings.')}; name another folder for --out"
                )
            if name == "settings.work_list":  # a checksum says nothing to a reader
                names = "names, classes, splits, axes or shape seeds"
                cause = f"made of another list of meshes (their {names} differ)"
            raise InputError(
                f"{folder}: {cause}; name another folder, or use what it was made with"
            )
    for package in sorted({*present.versions} & {*wanted.versions}):
        if present.versions[package] != wanted.versions[package]:
            warnings.warn(
                f"{folder}: begun with {package} {present.versions[package]}, continued with "
                f"{wanted.versions[package]}: rows may differ from those of one version",
                stacklevel=2,
            )


def open_dataset(folder: str | Path) -> Manifest:
    """Read ``dataset.json``."""
    path = Path(folder) / MANIFEST
    if not path.is_file():
        raise InputError(f"{folder}: not a qs3 data set (no {MANIFEST})")
    value = read_json(path)
    schema = value.get("schema") if isinstance(value, dict) else None
    if schema not in (None, SCHEMA_VERSION):
        raise InputError(
            f"{path}: schema {schema}, this version reads {SCHEMA_VERSION}; make the data set again"
        )
    return structure(value, Manifest, path)


def shard_name(index: int) -> str:
    """Return the file name of shard ``index``."""
    return f"shard-{index:05d}.parquet"


def finished_shards(folder: str | Path, count: int) -> list[int]:
    """Return the indices of the existing shards, of ``count`` planned."""
    present = {path.name for path in Path(folder).glob("shard-*.parquet")}
    return [index for index in range(count) if shard_name(index) in present]


def mesh_sums(paths: Mapping[str, Path]) -> dict[str, str]:
    """Return the SHA-256 of files of meshes by name; of a text glTF with the buffers beside it.

    A file that cannot be read has none: its scan will fail with the reason. A process reads a file
    once, until it changes.
    """
    sums = {}
    for name, path in paths.items():
        with contextlib.suppress(OSError):
            one, *more = [_sum_of(part, state_of(part)) for part in mesh_files(path)]
            sums[name] = hashlib.sha256("".join([one, *more]).encode()).hexdigest() if more else one
    return sums


@functools.lru_cache(maxsize=100_000)
def _sum_of(path: Path, state: tuple[int, ...]) -> str:
    return sha256(path)


def read_mesh_sums(folder: Path) -> dict[str, str]:
    """Return the checksums of the scanned meshes; empty if all are shapes."""
    path = folder / MESHES
    return structure(read_json(path), dict[str, str], path) if path.is_file() else {}


def write_failures(folder: Path, records: Iterable[Mapping[str, Any]]) -> None:
    """Replace the log, in the order of shards and rows; remove it if there are no records."""
    ordered = sorted(records, key=lambda record: (record["shard"], record["row"], record["id"]))
    if ordered:
        write_text(folder / FAILURES, "".join(json.dumps(record) + "\n" for record in ordered))
    else:
        (folder / FAILURES).unlink(missing_ok=True)


def read_failures(folder: str | Path) -> list[dict[str, Any]]:
    """Return the records of the scans that failed, in the order of their ids."""
    path = Path(folder) / FAILURES
    if not path.is_file():
        return []
    try:
        records = [parse_json(line, path) for line in path.read_text("utf-8").splitlines()]
        return sorted(records, key=lambda record: record["id"])
    except (KeyError, TypeError, ValueError) as error:
        fix = "delete it and run the same command again with --retry-failed"
        raise InputError(f"{path}: damaged ({error}); {fix}") from error


def refuse_failures(
    folder: str | Path,
    what: str,
    fix: str = "all others are there, --retry-failed does these again",
) -> None:
    """Raise an error that names the first failure and the fix, if there are any failures."""
    if failures := read_failures(folder):
        raise FailedScansError(
            f"{folder}/{FAILURES}: {len(failures)} {what} failed; the first: {failures[0]['id']}: "
            f"{failures[0]['reason']}; {fix}"
        )
