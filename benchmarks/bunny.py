"""Poses of a printed Stanford bunny in 36 real views, by its CAD alone.

Run: python benchmarks/bunny.py --shared DIR

DIR holds ``poses/`` of the shared data: views of a camera of the PrimeSense type, with poses that
were refined by their publishers and by us to about a millimetre. No view is learnt from.
"""

import argparse
import shutil
import tempfile
import time
from pathlib import Path

import numpy as np

from qs3.evaluation.poses import adds, turned_by
from qs3.parts import Library, locate


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--shared", type=Path, required=True)
    poses = parser.parse_args().shared / "poses"
    with tempfile.TemporaryDirectory() as folder:
        shutil.copy(poses / "bunny.ply", folder)
        library = Library.of_folder(folder, "m")
    (part,) = library.parts
    data = np.load(poses / "bunny_views.npz")
    views = np.split(data["points"].astype(np.float64), data["offset"][1:-1])
    turned, off, lost, start = [], [], 0, time.process_time()
    for view, pose in zip(views, data["pose"], strict=True):
        best = locate(library, view).best
        if best is None:
            raise SystemExit("a view is larger than the CAD")
        turned.append(turned_by(best.pose, pose))
        off.append(adds(best.pose, pose, part.points) / part.diameter)
        lost += best.lost
    seconds = (time.process_time() - start) / len(views)
    print(f"{len(views)} views: {sum(t < 10 for t in turned)} under 10 degrees, "
          f"{sum(t < 15 for t in turned)} under 15, {sum(o < 0.05 for o in off)} with ADD-S under "
          f"5 % of the diameter, {lost} called lost; {seconds:.2f} CPU s per view")  # fmt: skip


if __name__ == "__main__":
    main()
