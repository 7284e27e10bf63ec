"""Three parts whose CAD and scans take little time."""

from pathlib import Path

import pytest
import trimesh

from ..stores import generate_quickly, quicken

PARTS = {
    "block": trimesh.creation.box((60, 40, 20)),
    "rod": trimesh.creation.cylinder(10, 80),
    "wedge": trimesh.creation.cone(30, 50),
}
"""In millimetres."""


@pytest.fixture(scope="module", autouse=True)
def quick():
    """Few trees, and samples in place of simulated scans."""
    with pytest.MonkeyPatch.context() as patch:
        quicken(patch, 30)
        for place in ("workflow.adapt", "store.generate"):
            patch.setattr(f"qs3.{place}.generate", generate_quickly)
        yield


def write_cad(folder: Path) -> Path:
    """Write a file for each class."""
    folder.mkdir()
    for name, mesh in PARTS.items():
        mesh.export(folder / f"{name}.stl")
    return folder
