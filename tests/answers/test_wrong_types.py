"""Arguments that are None, of another type or swapped: one clear message of each function."""

import subprocess
import sys

ASK = """
import numpy as np, qs3
from qs3.parts import Library, find, locate, locate_all

points, library = np.ones((50, 3)), Library(())
rooms = qs3.load("rooms")
for call in (
    lambda: qs3.load(None), lambda: qs3.load_mesh(points), lambda: qs3.load_sensor(None),
    lambda: qs3.adapt(None, "scans"), lambda: qs3.adapt("cad", "scans", out=None),
    lambda: rooms.save(None), lambda: locate("cad", points), lambda: locate(points, library),
    lambda: locate_all("cad", [points]), lambda: find(np.ones((5, 5)), library, "9,9,2,2"),
):
    try:
        call()
    except qs3.errors.QS3Error as error:
        print(str(error).splitlines()[0])
"""


def test_wrong_types_and_swapped_arguments_are_named() -> None:
    # In a process of its own: the checks of types in tests would refuse them first.
    done = subprocess.run([sys.executable, "-c", ASK], capture_output=True, text=True, check=True)
    heads = ("load: 'None' is no path", "load_mesh: '[[1. 1.", "no sensor None;",
             "adapt: 'None' is no path", "adapt: 'None' is no path", "save: 'None' is no path",
             "locate: 'cad' is no qs3.parts.Library", "locate: '[[1. 1.",
             "locate_all: 'cad' is no qs3.parts.Library", "find: '[[1. 1.")  # fmt: skip
    lines = done.stdout.splitlines()
    assert len(lines) == len(heads), lines
    for line, head in zip(lines, heads, strict=True):
        assert line.startswith(head)
