"""Small trees of meshes on disk."""

from collections.abc import Callable
from pathlib import Path

import pytest

TRIANGLE = {
    ".off": "OFF\n3 1 0\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n",
    ".obj": "v 0 0 0\nv 1 0 0\nv 0 3 0\nf 1 2 3\n",
}


@pytest.fixture
def tree(tmp_path: Path) -> Callable[..., Path]:
    """Make files below a fresh root; what they hold is a triangle where the ending has one."""

    def make(*names: str) -> Path:
        root = tmp_path / "root"
        root.mkdir(exist_ok=True)
        for name in names:
            path = root / name
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_text(TRIANGLE.get(path.suffix.lower(), ""))
        return root

    return make
