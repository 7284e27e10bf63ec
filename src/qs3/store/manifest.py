"""``dataset.json`` and ``SHA256SUMS``: what a data set is made of, and the checksums of it."""

import dataclasses
import json
import warnings
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from qs3.errors import InputError
from qs3.store.folder import Folder, open_folder

MANIFEST = "dataset.json"
SUMS = "SHA256SUMS"
SCHEMA_VERSION = 3
_READABLE = (1, 2, 3)  # 2 has the column `drawn`; 3 checksums, half precision, unknown row counts


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
    schema: int = SCHEMA_VERSION
    """Version of the columns."""

    def as_dict(self) -> dict[str, Any]:
        """Return plain values, as in the JSON file."""
        return {**dataclasses.asdict(self), "class_names": list(self.class_names)}


def write_manifest(where: str | Path | Folder, manifest: Manifest) -> None:
    """Write ``dataset.json``, or accept the one that is there if its settings are the same.

    Raises:
        InputError: where the folder holds a data set of other settings; the first is named.
    """
    folder = open_folder(where)
    if folder.exists(MANIFEST):
        check_same(str(folder), open_dataset(folder), manifest)
        return
    text = json.dumps(manifest.as_dict(), indent=2, allow_nan=False, ensure_ascii=False) + "\n"
    folder.write(MANIFEST, text.encode("utf-8"))


def check_same(where: str, there: Manifest, wanted: Manifest) -> None:
    """Refuse a data set of other settings than those wanted; warn where versions differ.

    Raises:
        InputError: naming ``where`` and the first setting that differs.
    """
    old, new = (json.loads(json.dumps(one.as_dict())) for one in (there, wanted))
    for key in ("schema", "settings", "class_names", "rows", "shards"):
        name, was, now = _difference(key, old[key], new[key])
        if name:
            raise InputError(
                f"{where}: made with {name.removeprefix('settings.')} = {was}, not {now}; "
                "name another folder, or use the same settings"
            )
    for package in sorted({*there.versions} & {*wanted.versions}):
        if there.versions[package] != wanted.versions[package]:
            warnings.warn(
                f"{where}: begun with {package} {there.versions[package]}, going on with "
                f"{wanted.versions[package]}: rows may differ from those of one version",
                stacklevel=2,
            )


def _difference(name: str, old: Any, new: Any) -> tuple[str, Any, Any]:
    """Name and both values of the first setting that differs; an empty name where none does."""
    if isinstance(old, Mapping) and isinstance(new, Mapping):
        for key in sorted({*old, *new}):
            found = _difference(f"{name}.{key}", old.get(key), new.get(key))
            if found[0]:
                return found
        return "", None, None
    return ("", None, None) if old == new else (name, old, new)


def open_dataset(where: str | Path | Folder) -> Manifest:
    """Read ``dataset.json``.

    Raises:
        InputError: where it is missing, damaged, or of another schema version.
    """
    folder = open_folder(where)
    if not folder.exists(MANIFEST):
        raise InputError(f"{folder}: not a qs3 data set (no {MANIFEST})")
    path = f"{folder}/{MANIFEST}"
    try:
        value = json.loads(folder.read(MANIFEST).decode("utf-8"))
    except (UnicodeDecodeError, json.JSONDecodeError, RecursionError) as error:
        raise InputError(f"{path}: not a JSON file ({error})") from error
    names = {field.name for field in dataclasses.fields(Manifest)}
    if not isinstance(value, dict) or set(value) != names or not _well_typed(value):
        raise InputError(f"{path}: not the description of a qs3 data set; make it again")
    if value["schema"] not in _READABLE:
        raise InputError(
            f"{path}: schema {value['schema']}, this version reads up to {SCHEMA_VERSION}; make "
            "it again"
        )
    return Manifest(**{**value, "class_names": tuple(value["class_names"])})


def _well_typed(value: Mapping[str, Any]) -> bool:
    def count(number: Any) -> bool:
        return type(number) is int and 0 <= number < 10**9

    names = value["class_names"]
    return (
        isinstance(value["settings"], dict)
        and isinstance(value["versions"], dict)
        and isinstance(names, list)
        and all(isinstance(name, str) for name in names)
        and (value["rows"] is None or count(value["rows"]))
        and count(value["shards"])
    )


def shard_name(index: int) -> str:
    """Return the file name of shard ``index``.

    Example:
        >>> shard_name(3)
        'shard-00003.parquet'
    """
    return f"shard-{index:05d}.parquet"


def shard_path(folder: Path, index: int) -> Path:
    """Return the path of shard ``index`` of a data set on a disk."""
    return Path(folder) / shard_name(index)


def finished_shards(folder: Folder, count: int) -> list[int]:
    """Indices of the shards, of ``count`` planned, that are there."""
    there = set(folder.names())
    return [index for index in range(count) if shard_name(index) in there]


def write_sums(folder: Folder, sums: Mapping[str, str]) -> None:
    """Write ``SHA256SUMS`` anew, in the layout that ``sha256sum --check`` reads."""
    lines = [f"{digest}  {name}\n" for name, digest in sorted(sums.items())]
    folder.write(SUMS, "".join(lines).encode("ascii"))


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
