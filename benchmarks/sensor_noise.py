"""The noise of the simulated sensor beside that of the official code's own stereo pair.

Reference figures (measured on the one rendered pair in the released repository's history, 800²,
baseline 0.2, depth 1.4 to 2.5): disparity σ 0.25 px, bias +0.03 px, gross errors 0.9 %, valid 85 %
of the object's pixels, 70 % of the 10-px ring outside the silhouette filled.

    QS3_SHARED_DATA=… python benchmarks/sensor_noise.py [--samples 8] [--scans 3]
"""

import argparse
import os
from pathlib import Path

import numpy as np

from qs3.meshes import load_mesh
from qs3.sensor.presets import get_sensor
from qs3.sensor.render.mitsuba import MitsubaRenderer
from qs3.sensor.scan import scan
from qs3.sensor.statistics import view_statistics

MESHES = ("bed/kenney__bedDouble.ply", "bed/aws__Bed_01.ply", "chair/aws__ChairA_01.ply")
COLUMNS = ["sensor", "mesh", "σ", "bias", "gross", "valid", "valid-beyond-left-band", "ring"]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--samples", type=int, default=8)
    parser.add_argument("--scans", type=int, default=3)
    options = parser.parse_args()
    root = Path(os.environ["QS3_SHARED_DATA"]) / "cad"
    renderer = MitsubaRenderer(samples=options.samples)
    print(f"{renderer.variant}, {options.samples} rays a pixel; medians over the views")
    print("| " + " | ".join(COLUMNS) + " |\n|" + "---|" * len(COLUMNS))
    for name in ("paper", "qs3-800"):
        sensor = get_sensor(name)
        band = sensor.matching.num_disparities + sensor.matching.block_size // 2
        for mesh in MESHES:
            rows = []
            for seed in range(options.scans):
                made = scan(
                    load_mesh(root / mesh),
                    sensor=sensor,
                    seed=seed,
                    views=4,
                    renderer=renderer,
                    keep_images=True,
                )
                for view, image in zip(made.views, made.images, strict=True):
                    # OpenCV never matches the first columns of the frame: the left band.
                    inside = max(0, band - image.region.x)
                    rest = view_statistics(
                        image.disparity[:, inside:], image.true_depth[:, inside:], sensor.rig
                    )
                    rows.append(
                        [
                            view.disparity_sigma,
                            view.disparity_bias,
                            view.gross_share,
                            view.valid_fraction,
                            rest.valid_fraction,
                            view.ring_fraction,
                        ]
                    )
            s, bias, gross, valid, beyond, ring = np.median(np.array(rows, dtype=float), axis=0)
            print(
                f"| {name} | {mesh} | {s:.3f} px | {bias:+.3f} px | {gross:.2%} | {valid:.0%} | "
                f"{beyond:.0%} | {ring:.0%} |"
            )


if __name__ == "__main__":
    main()
