"""The way of ``qs3 locate`` with a kept library to its first answer."""

import os
import subprocess
import sys
from dataclasses import replace

import numpy as np
import pytest

from qs3 import shapes
from qs3.parts import Library
from qs3.store.manifest import mesh_sums

from ..stores import view_once

NEEDLESS = {"torch", "sklearn", "trimesh", "pandas", "cv2", "pyarrow", "filelock"}
CODE = """
import sys, time
from qs3.cli import run
run(sys.argv[1:])  # what is compiled is loaded, or compiled
waited = time.process_time() - time.thread_time()
worked = time.thread_time()
run(sys.argv[1:])
print(time.process_time() - time.thread_time() - waited, time.thread_time() - worked)
print(*sys.modules)
"""


@pytest.fixture(scope="module")
def answered(tmp_path_factory) -> list[str]:
    """Output of a process that locates two scans of which one lies on a table."""
    folder = tmp_path_factory.mktemp("start")
    parts = []
    for name in ("bolt", "elbow", "flange"):
        mesh = shapes.make(name, 0)
        (folder / "cad").mkdir(exist_ok=True)
        mesh.export(folder / "cad" / f"{name}.stl")
        digest = mesh_sums({name: folder / "cad" / f"{name}.stl"})[name]
        parts.append(replace(view_once(mesh, 1.0, name, name), digest=digest))
    Library(tuple(parts)).save(folder / "kept.safetensors")
    points = parts[0].points[parts[0].seen[20]]
    np.save(folder / "scan.npy", points)
    (folder / "table").mkdir()
    np.save(folder / "table" / "scan.npy", points - points.min(axis=0))
    row = "file,distance,elevation,z\nscan.npy,0.6,45,0.01\n"
    (folder / "table" / "objects.csv").write_text(row, encoding="utf-8")
    words = ["locate", "cad", "scan.npy", "table/scan.npy", "--units", "m"]
    done = subprocess.run(
        [sys.executable, "-c", CODE, *words, "--library", "kept.safetensors"],
        cwd=folder, env=os.environ | {"OPENBLAS_NUM_THREADS": "2", "OMP_NUM_THREADS": "2"},
        capture_output=True, text=True,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    return done.stdout.splitlines()


def test_parts_are_compared_in_one_thread(answered):
    """A library of linear algebra starts threads for large products, and they spin."""
    others, alone = map(float, answered[-2].split())
    assert others < 0.03 * alone


def test_nothing_that_it_needs_not_is_loaded(answered):
    assert not NEEDLESS & {*answered[-1].split()}
