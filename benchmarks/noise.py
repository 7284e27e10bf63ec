"""Noise of the simulated sensor: Mitsuba against Cycles, and the paper's sensor against its code.

    QS3_SHARED_DATA=… python benchmarks/noise.py renderers --out renderers.json [--samples 128]
    QS3_SHARED_DATA=… python benchmarks/noise.py sensors [--samples 8] [--scans 3]

``renderers``: ten meshes, the same rig, poses and matching; --samples are Cycles' rays a pixel. A
mesh that the file holds is not measured again. ``sensors``: the one rendered pair in the released
repository's history (800², baseline 0.2, depth 1.4 to 2.5) has a disparity σ of 0.25 px, bias
+0.03 px, gross errors 0.9 %, valid 85 % of the object's pixels, and 70 % of a ring of 10 px outside
the silhouette filled.
"""

import argparse
import json
import os
from pathlib import Path

import numpy as np

from qs3.meshes import load_mesh
from qs3.sensor.render.cycles import CyclesRenderer
from qs3.sensor.render.mitsuba import MitsubaRenderer
from qs3.sensor.scan import scan

CLASSES = ("bathtub", "bed", "bookshelf", "cabinet", "chair")
CLASSES += ("lamp", "monitor", "plant", "sofa", "table")
MESHES = ("bed/kenney__bedDouble.ply", "bed/aws__Bed_01.ply", "chair/aws__ChairA_01.ply")
KEYS = ("disparity_sigma", "disparity_bias", "gross_share", "valid_fraction", "ring_fraction")
AIMS = (("σ, ratio", 1.0, 0.15), ("bias, px", 0.0, 0.02), ("valid pixels", 0.0, 0.03))
"""What is compared, its value for equal renderers, and how far it may be off."""


def measured(path: Path, **how) -> list[list[float]]:
    """Noise of each view of a scan, as `KEYS`."""
    views = scan(load_mesh(path), **how).views
    return [[getattr(view, key) for key in KEYS] for view in views]


def renderers(root: Path, options: argparse.Namespace) -> None:
    rows = json.loads(options.out.read_text()) if options.out.is_file() else {}
    made = {"mitsuba": MitsubaRenderer(), "cycles": CyclesRenderer(samples=options.samples)}
    for seed, name in enumerate(CLASSES):
        path = sorted((root / name).iterdir())[0]
        if name not in rows:
            how = {"seed": seed, "views": options.views}
            rows[name] = {
                key: np.nanmean(
                    np.array(measured(path, renderer=one, **how), dtype=float), axis=0
                ).tolist()
                for key, one in made.items()
            }
            options.out.write_text(json.dumps(rows, indent=1))
        print(path.name, rows[name], flush=True)
    ours, theirs = (np.array([row[key] for row in rows.values()]) for key in made)
    values = ours[:, 0] / theirs[:, 0], ours[:, 1] - theirs[:, 1], ours[:, 3] - theirs[:, 3]
    print("| Mitsuba against Cycles | median | aim | reached |\n|---|---|---|---|")
    for (name, equal, bound), value in zip(AIMS, values, strict=True):
        good = (np.abs(value - equal) <= bound).sum()
        print(f"| {name} | {np.median(value):+.3f} | ± {bound} | {good} of {len(rows)} |")


def sensors(root: Path, options: argparse.Namespace) -> None:
    renderer = MitsubaRenderer(samples=options.samples)
    print(f"{renderer.variant}, {options.samples} rays a pixel; medians over the views")
    print("| sensor | mesh | σ | bias | gross | valid | ring |\n|---|---|---|---|---|---|---|")
    for name in ("paper", "qs3-800"):
        for mesh in MESHES:
            rows: list[list[float]] = []
            for seed in range(options.scans):
                rows += measured(root / mesh, sensor=name, seed=seed, views=4, renderer=renderer)
            s, bias, gross, valid, ring = np.median(np.array(rows, dtype=float), axis=0)
            print(
                f"| {name} | {mesh} | {s:.3f} px | {bias:+.3f} px | {gross:.2%} | {valid:.0%} | "
                f"{ring:.0%} |"
            )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("what", choices=["renderers", "sensors"])
    parser.add_argument("--out", type=Path, default=Path("renderers.json"))
    parser.add_argument("--samples", type=int, default=8)
    parser.add_argument("--scans", type=int, default=3, help="of each mesh by each sensor")
    parser.add_argument("--views", type=int, default=2, help="of each mesh by each renderer")
    options = parser.parse_args()
    root = Path(os.environ["QS3_SHARED_DATA"]) / "cad"
    {"renderers": renderers, "sensors": sensors}[options.what](root, options)


if __name__ == "__main__":
    main()
