"""Parts of one data set, made on several machines, put into one folder."""

import contextlib
import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any

from qs3.errors import InputError
from qs3.store.failures import read_failures, write_failures
from qs3.store.folder import Folder, open_folder
from qs3.store.manifest import (
    MANIFEST,
    Sums,
    changed_meshes,
    check_same,
    finished_shards,
    open_dataset,
    read_mesh_sums,
    read_sums,
    shard_name,
    write_manifest,
    write_mesh_sums,
)
from qs3.store.progress import progress_bar


@dataclass(frozen=True)
class MergeReport:
    """What one call of `merge` did."""

    copied: int
    """Shards copied by this call."""
    skipped: int
    """Shards that were there before."""
    failed: int
    """Failed scans in the log of the whole."""


def merge(parts: Sequence[str | Path], out: str | Path, *, progress: bool = True) -> MergeReport:
    """Copy the shards of several parts into one data set, as if one machine had made it.

    Run again after a stop, it goes on. The parts stay as they are.

    Args:
        parts: Folders, or addresses that fsspec knows, that ``generate`` with ``shard`` wrote.
        out: New or empty folder, or one that the same call began.
        progress: Show a bar on the standard error stream.

    Raises:
        InputError: where a part has other settings than the first, a shard is damaged, differs
            between two parts or is in none; or the folder holds something else.
    """
    if not parts:
        raise InputError("no part to merge; name the folders that qs3 generate --shard wrote")
    folders = [open_folder(part) for part in parts]
    manifest = open_dataset(folders[0])
    for folder in folders[1:]:
        check_same(str(folder), open_dataset(folder), manifest)
    meshes = _meshes(folders)
    sources = _sources(folders, manifest.shards)
    target = open_folder(out)
    copied = 0
    with target.claimed(MANIFEST), contextlib.ExitStack() as at_the_end:
        write_manifest(target, manifest)
        done = Sums(target)
        at_the_end.callback(done.write)
        present = set(finished_shards(target, manifest.shards))
        for name in map(shard_name, sorted(present)):
            if name in done and sources[name][1] not in (None, done[name]):
                raise InputError(
                    f"{target}/{name}: is neither part's any more, failed scans were made up for "
                    "here or there; merge into a new folder"
                )
        write_mesh_sums(target, meshes)
        failures: dict[str, dict[str, Any]] = {}
        for folder in folders:
            failures |= {record["id"]: record for record in read_failures(folder)}
        write_failures(target, failures.values())
        text = "merge" if progress else None
        for index in progress_bar(manifest.shards, text, "shard", items=range(manifest.shards)):
            name = shard_name(index)
            source, expected = sources[name]
            if index in present and name in done and done[name] == expected:
                continue
            content = source.read(name)
            digest = sha256(content).hexdigest()
            if expected not in (None, digest):
                raise InputError(
                    f"{source}/{name}: damaged, its checksum is not the one in SHA256SUMS; delete "
                    "it and run that part again"
                )
            target.write(name, content)
            done.note(name, digest)
            copied += 1
    return MergeReport(copied, manifest.shards - copied, len(failures))


def _meshes(folders: Sequence[Folder]) -> dict[str, str]:
    """Checksums of the meshes of all parts; refuse parts that were made from other files."""
    meshes: dict[str, str] = {}
    for folder in folders:
        own = read_mesh_sums(folder)
        if changed := changed_meshes(meshes, own):
            raise InputError(
                f"{folder}: was made from other files than the parts named before it: "
                f"{', '.join(changed[:5])}{' …' if len(changed) > 5 else ''}; run these parts again"
            )
        meshes |= own
    return meshes


def _sources(folders: Sequence[Folder], shards: int) -> dict[str, tuple[Folder, str | None]]:
    """For each shard the first part that has it, and its checksum if any part knows that."""
    sources: dict[str, tuple[Folder, str | None]] = {}
    for folder in folders:
        sums = read_sums(folder)
        for name in map(shard_name, finished_shards(folder, shards)):
            first, digest = sources.get(name, (folder, None))
            if digest and sums.get(name, digest) != digest:
                raise InputError(f"{name} differs between {first} and {folder}")
            sources[name] = first, digest or sums.get(name)
    missing = shards - len(sources)
    if missing:
        lost = (index for index in range(shards) if shard_name(index) not in sources)
        some = ", ".join(map(str, itertools.islice(lost, 8))) + (" …" if missing > 8 else "")
        raise InputError(
            f"{missing} of {shards} shards are in none of the {len(folders)} parts "
            f"(numbers {some}); finish those parts first"
        )
    return sources
