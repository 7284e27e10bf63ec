"""``meshes.json``: the checksum of each mesh file that a data set is made from."""

import concurrent.futures
import hashlib
import json
from collections.abc import Mapping, Sequence
from pathlib import Path

from qs3.errors import InputError
from qs3.files import sha256
from qs3.store.folder import Folder
from qs3.store.scan_item import Item

MESHES = "meshes.json"


def mesh_sums(items: Sequence[Item]) -> dict[str, str]:
    """Return the SHA-256 of every item's file, by the item's id; shapes have none.

    A file that cannot be read has none either: its scan will fail, and say why.
    """
    paths = {item.id: getattr(item, "path", None) for item in items}
    files = {name: Path(path) for name, path in paths.items() if path is not None}
    with concurrent.futures.ThreadPoolExecutor() as pool:
        sums = dict(zip(files, pool.map(_sum, files.values()), strict=True))
    return {name: digest for name, digest in sums.items() if digest}


def _sum(path: Path) -> str:
    """Checksum of a mesh file; of a glTF in text, with the buffers that lie beside it."""
    try:
        if path.suffix.lower() != ".gltf":
            return sha256(path)
        parts = [path, *sorted(path.parent.glob("*.bin"))]
        return hashlib.sha256("".join(map(sha256, parts)).encode()).hexdigest()
    except OSError:
        return ""


def read_mesh_sums(folder: Folder) -> dict[str, str]:
    """Return what an earlier call noted; nothing where there is no ``meshes.json``.

    Raises:
        InputError: where the file is damaged.
    """
    if not folder.exists(MESHES):
        return {}
    try:
        sums = json.loads(folder.read(MESHES).decode("utf-8"))
    except (UnicodeDecodeError, json.JSONDecodeError, RecursionError) as error:
        raise InputError(f"{folder}/{MESHES}: damaged ({error}); delete it") from error
    if not isinstance(sums, dict) or not all(isinstance(value, str) for value in sums.values()):
        raise InputError(f"{folder}/{MESHES}: damaged (not one checksum a mesh); delete it")
    return sums


def write_mesh_sums(folder: Folder, sums: Mapping[str, str]) -> None:
    """Write ``meshes.json``, one line a mesh; none where no mesh is a file."""
    if sums:
        text = json.dumps(dict(sorted(sums.items())), indent=0, ensure_ascii=False)
        folder.write(MESHES, f"{text}\n".encode())


def changed_meshes(there: Mapping[str, str], now: Mapping[str, str]) -> list[str]:
    """Ids of the meshes whose files are not those that were noted."""
    return [name for name, digest in now.items() if there.get(name, digest) != digest]
