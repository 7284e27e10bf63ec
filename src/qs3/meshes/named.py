"""One mesh by the name that a user gives: a file, or a built-in class."""

from pathlib import Path
from typing import Literal

import trimesh

from qs3 import shapes
from qs3.errors import InputError
from qs3.files import sha256
from qs3.meshes.loading import load_mesh


def load_named(
    name: str, seed: int, up: Literal["z", "y"] | None = None
) -> tuple[trimesh.Trimesh, dict[str, str]]:
    """Return the mesh of a file or a built-in class, and where it is from, for records.

    Args:
        name: A path, or one of `qs3.shapes.CLASSES` where no file has that name.
        seed: Which draw of a built-in class.
        up: Up axis of a file; by default y for glTF, z for all others.

    Raises:
        InputError: where it is neither, or the file holds no mesh.
    """
    if name in shapes.CLASSES and not Path(name).exists():
        return shapes.make(name, seed=seed), {"name": name, "source": "shapes", "sha256": ""}
    path = Path(name)
    if not path.suffix and not path.exists():
        raise InputError(
            f"{name}: neither a mesh file nor a built-in class ({', '.join(shapes.CLASSES)})"
        )
    return load_mesh(path, up), {"name": path.name, "source": "file", "sha256": sha256(path)}
