"""What lies beside the shards: ``dataset.json``, ``SHA256SUMS`` and ``meshes.json``."""

import concurrent.futures
import functools
import hashlib
import itertools
import json
import platform
import re
import time
import warnings
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from qs3.errors import InputError
from qs3.files import json_bytes, parse_json, sha256
from qs3.store.folder import Folder, open_folder
from qs3.structure import fill, first_difference, structure, unstructure

MANIFEST = "dataset.json"
SUMS = "SHA256SUMS"
MESHES = "meshes.json"
SCHEMA_VERSION = 3
_READABLE = (1, 2, 3)  # 2 has the column `drawn`; 3 checksums, half precision, unknown row counts
_LARGEST = 10**9  # rows and shards
_SHARD = re.compile(r"shard-(\d{5,18})\.parquet", re.ASCII)
_SUMS_EVERY = 5.0  # seconds; the whole file is written anew each time
_PACKAGES = (
    *("qs3", "mitsuba", "numpy", "opencv-python-headless"),
    *("pyarrow", "scipy", "torch", "trimesh"),
)


@dataclass(frozen=True)
class Manifest:
    """What ``dataset.json`` says of a data set."""

    settings: Mapping[str, Any]
    """Every setting that the rows depend on, as plain values."""
    class_names: tuple[str, ...]
    """Classes in the order of the label."""
    rows: int | None
    """Rows planned (failed objects are absent); None where only the scans will tell."""
    shards: int
    """Shards planned."""
    versions: Mapping[str, str]
    """Versions of the packages that began it."""
    renamed: Mapping[str, str] = field(default_factory=dict)
    """Classes of the meshes that go by another name here; not in the file where there is none."""
    schema: int = SCHEMA_VERSION
    """Version of the columns."""

    def __post_init__(self) -> None:
        for name, count in (("rows", self.rows or 0), ("shards", self.shards)):
            if not 0 <= count < _LARGEST:
                raise InputError(f"{name} must be from 0 to {_LARGEST}, not {count}")
        for name in ("seed", "views"):  # those that are counted with
            value = self.settings.get(name, 0)
            if type(value) is not int or not 0 <= value < 2**63:
                raise InputError(f"settings.{name} must be a whole number from 0, not {value!r}")


def package_versions(*more: str) -> dict[str, str]:
    """Return the versions of Python and of the packages that a result depends on, by name.

    Read from the packages' metadata; nothing is imported. ``more`` names other packages.

    Example:
        >>> sorted(package_versions())[:2]
        ['mitsuba', 'numpy']
    """
    versions = {"python": platform.python_version()}
    for name in (*_PACKAGES, *more):
        try:
            versions[name] = version(name)
        except PackageNotFoundError:
            continue
    return versions


def write_manifest(where: str | Path | Folder, manifest: Manifest) -> None:
    """Write ``dataset.json``, or accept the one that is there if its settings are the same.

    Raises:
        InputError: where the folder holds a data set of other settings; the first is named.
    """
    folder = open_folder(where)
    if folder.exists(MANIFEST):
        check_same(str(folder), open_dataset(folder), manifest)
    else:
        value = unstructure(manifest)
        if not manifest.renamed:
            del value["renamed"]
        folder.write(MANIFEST, json_bytes(value))


def check_same(where: str, present: Manifest, wanted: Manifest) -> None:
    """Refuse a data set of other settings than those wanted; warn where versions differ.

    Raises:
        InputError: naming ``where`` and the first setting that differs.
    """
    from qs3.store.scan_item import GenerateSettings

    old, new = unstructure(present), unstructure(wanted)
    defaults = unstructure(GenerateSettings().as_dict())
    old["settings"] = fill(old["settings"], new["settings"], defaults)
    for key in ("schema", "settings", "class_names", "rows", "shards"):
        difference = first_difference(old[key], new[key], key)
        if difference is not None:
            name, was, now = difference
            if name == "settings.work_list":  # a checksum, which would tell a reader nothing
                raise InputError(
                    f"{where}: made of another list of meshes (their names, classes, splits, axes "
                    "or shape seeds differ); name another folder, or the same meshes"
                )
            raise InputError(
                f"{where}: made with {name.removeprefix('settings.')} = {was}, not {now}; "
                "name another folder, or use the same settings"
            )
    for package in sorted({*present.versions} & {*wanted.versions}):
        if present.versions[package] != wanted.versions[package]:
            warnings.warn(
                f"{where}: begun with {package} {present.versions[package]}, going on with "
                f"{wanted.versions[package]}: rows may differ from those of one version",
                stacklevel=2,
            )


def open_dataset(where: str | Path | Folder) -> Manifest:
    """Read ``dataset.json``.

    Raises:
        InputError: where it is missing, damaged, or of another schema version.
    """
    folder = open_folder(where)
    if not folder.exists(MANIFEST):
        raise InputError(f"{folder}: not a qs3 data set (no {MANIFEST})")
    path = f"{folder}/{MANIFEST}"
    value = parse_json(folder.read(MANIFEST), path)
    schema = value.get("schema") if isinstance(value, dict) else None
    if schema is not None and schema not in _READABLE:
        raise InputError(
            f"{path}: schema {schema}, this version reads up to {SCHEMA_VERSION}; make it again"
        )
    manifest = structure(value, Manifest, path)
    sensor = manifest.settings.get("sensor")
    if isinstance(sensor, dict) and sensor.get("name") == "qs3":
        sensor["name"] = "paper"  # as version 0.1 called it
    return manifest


def shard_name(index: int) -> str:
    """Return the file name of shard ``index``.

    Example:
        >>> shard_name(3)
        'shard-00003.parquet'
    """
    return f"shard-{index:05d}.parquet"


def finished_shards(folder: Folder, count: int) -> list[int]:
    """Indices of the shards, of ``count`` planned, that are there."""
    # The plan may say anything; what is there tells how much there is to do.
    names = set(folder.names())
    numbers = {int(match[1]) for match in map(_SHARD.fullmatch, names) if match}
    return sorted(n for n in numbers if n < count and shard_name(n) in names)


def read_sums(folder: Folder) -> dict[str, str]:
    """Return the checksum of each shard by its name; none where there is no ``SHA256SUMS``.

    Raises:
        InputError: where the file is damaged.
    """
    if not folder.exists(SUMS):
        return {}
    sums = {}
    for line in folder.read(SUMS).decode("utf-8", errors="replace").splitlines():
        digest, gap, name = line[:64], line[64:66], line[66:]
        if gap != "  " or not name or not set(digest) <= set("0123456789abcdef"):
            raise InputError(f"{folder}/{SUMS}: damaged line {line[:80]!r}; delete the file")
        sums[name] = digest
    return sums


class Sums(dict[str, str]):
    """Checksums of a data set's shards, as read and as they come.

    ``SHA256SUMS`` is written anew every few seconds: a shard that it lacks is simply put together
    or copied again, and a whole file for every shard would cost more than the shards.
    """

    def __init__(self, folder: Folder) -> None:
        super().__init__(read_sums(folder))
        self._folder, self._written, self._time = folder, dict(self), time.monotonic()

    def note(self, name: str, digest: str) -> None:
        """Take in the checksum of a shard."""
        self[name] = digest
        if time.monotonic() - self._time > _SUMS_EVERY:
            self.write()

    def write(self) -> None:
        """Write the file anew, as ``sha256sum --check`` reads it, if something has come since."""
        if self != self._written:
            lines = [f"{digest}  {name}\n" for name, digest in sorted(self.items())]
            self._folder.write(SUMS, "".join(lines).encode("ascii"))
        self._written, self._time = dict(self), time.monotonic()


def mesh_sums(items: Iterable[Any]) -> dict[str, str]:
    """Return the SHA-256 of every mesh's file, by the mesh's id; shapes have none.

    A file that cannot be read has none either: its scan will fail, and say why.
    """
    sums, left = {}, iter(items)
    with concurrent.futures.ThreadPoolExecutor() as pool:
        while some := list(itertools.islice(left, 4096)):  # the pool takes in all that it is given
            for item, digest in zip(some, pool.map(_mesh_sum, some), strict=True):
                if digest:
                    sums[item.id] = digest
    return sums


def _mesh_sum(item: Any) -> str:
    """Checksum of a mesh file; of a glTF in text, with the buffers that lie beside it."""
    if (path := getattr(item, "path", None)) is None:
        return ""
    try:
        if path.suffix.lower() != ".gltf":
            return sha256(path)
        parts = [path, *sorted(path.parent.glob("*.bin"))]
        return hashlib.sha256("".join(map(sha256, parts)).encode()).hexdigest()
    except OSError:
        return ""


def read_mesh_sums(folder: Folder) -> dict[str, str]:
    """Return the checksums of the meshes that were scanned; none where all are shapes.

    Raises:
        InputError: where ``meshes.json`` is damaged.
    """
    if not folder.exists(MESHES):
        return {}
    where = f"{folder}/{MESHES}"
    sums = parse_json(folder.read(MESHES), where)
    if not isinstance(sums, dict) or not all(isinstance(value, str) for value in sums.values()):
        raise InputError(f"{where}: damaged (not one checksum a mesh); delete it")
    return sums


def write_mesh_sums(folder: Folder, sums: Mapping[str, str]) -> None:
    """Write ``meshes.json``, one line a mesh; none where no mesh is a file."""
    if sums:
        line = functools.partial(json.dumps, ensure_ascii=False)
        lines = ",\n".join(f"{line(name)}: {line(sums[name])}" for name in sorted(sums))
        folder.write(MESHES, f"{{\n{lines}\n}}\n".encode())


def changed_meshes(noted: Mapping[str, str], now: Mapping[str, str]) -> list[str]:
    """Ids of the meshes whose files are not those that were noted."""
    return [name for name, digest in now.items() if noted.get(name, digest) != digest]
