"""Merge the parts of a data set that several machines made."""

from collections.abc import Sequence
from pathlib import Path

from qs3.errors import InputError
from qs3.files import write_bytes, write_json
from qs3.store.bars import progress_bar
from qs3.store.manifest import (
    MESHES,
    Report,
    check_same,
    claimed,
    finished_shards,
    open_dataset,
    read_failures,
    read_mesh_sums,
    shard_name,
    write_failures,
    write_manifest,
)


def merge(parts: Sequence[str | Path], out: str | Path, *, progress: bool = True) -> Report:
    """Copy the shards of parts that ``generate`` with ``shard`` wrote into one data set.

    The bytes are those of one machine. Run it again after a stop: existing shards are skipped.
    """
    if not parts:
        raise InputError("no part to merge; name the folders that qs3 generate --shard wrote")
    folders = [Path(part) for part in parts]
    manifest = open_dataset(folders[0])
    sources: dict[int, Path] = {}
    meshes: dict[str, str] = {}
    for folder in folders:
        check_same(folder, open_dataset(folder), manifest)
        for index in finished_shards(folder, manifest.shards):
            sources.setdefault(index, folder)
        for name, digest in read_mesh_sums(folder).items():
            if meshes.setdefault(name, digest) != digest:
                raise InputError(f"{folder}: {name} was another file than in the parts before it")
    missing = [index for index in range(manifest.shards) if index not in sources]
    if missing:
        some = ", ".join(map(str, missing[:8])) + (" …" if len(missing) > 8 else "")
        raise InputError(
            f"{len(missing)} of {manifest.shards} shards are in none of the {len(folders)} parts "
            f"(numbers {some}); finish those parts first"
        )
    target = Path(out)
    with claimed(target):
        write_manifest(target, manifest)
        if meshes:
            write_json(target / MESHES, meshes)
        present = {*finished_shards(target, manifest.shards)}
        left = [index for index in range(manifest.shards) if index not in present]
        failures = [record for record in read_failures(target) if record["shard"] in present]
        for folder in folders:
            shards = {index for index in left if sources[index] == folder}
            failures += (record for record in read_failures(folder) if record["shard"] in shards)
        write_failures(target, failures)
        for index in progress_bar(len(left), "merge" if progress else None, "shard", items=left):
            name = shard_name(index)
            write_bytes(target / name, (sources[index] / name).read_bytes())
    return Report(len(left), len(present), len(failures))
