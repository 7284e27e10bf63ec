"""Three parts whose CAD and scans take little time."""

from pathlib import Path

import pytest
import trimesh

from ..stores import generate_quickly, view_once

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
        patch.setattr("qs3.parts.forest.TREES", 30)
        patch.setattr("qs3.parts.cad.JUDGED", 6)
        patch.setattr("qs3.parts.library.view_of", view_once)
        for place in ("workflow.adapt", "store.generate"):
            patch.setattr(f"qs3.{place}.generate", generate_quickly)
        yield


def write_cad(folder: Path) -> Path:
    """Write a file for each class."""
    folder.mkdir()
    for name, mesh in PARTS.items():
        mesh.export(folder / f"{name}.stl")
    return folder
