"""The matchers on a real infrared pair beside the camera's own depth: a table of docs/sensors.md.

The D435's in `ir` of the folder that QS3_SHARED_DATA names, 848 × 480, f 427.12 px, b 50 mm,
128 disparities. Valid pixels right of column 48; median of the differences from the camera, the
share above 3 px, and that above 1 px where the camera's disparity differs by 4 px within 8 px; RMS
on 13 patches of floor and box after a plane is taken off; processor seconds, the least of three.

    python benchmarks/matching.py [--threads 1]
"""

import argparse
import os
import time
import warnings
from pathlib import Path

import cv2
import numpy as np

from qs3.sensor.matching import MatchingSettings, match
from qs3.sensor.matching.settings import Method
from qs3.sensor.realism import near_steps, plane_noise


def real_pair() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Both images, and the disparity of the camera's own depth, in steps of about 5 mm."""
    folder = Path(os.environ["QS3_SHARED_DATA"]) / "ir"
    left, right = (
        cv2.imread(str(folder / f"d435_{side}.png"), cv2.IMREAD_GRAYSCALE)
        for side in ("left", "right")
    )
    picture = cv2.imread(str(folder / "d435_depth_preview.png")).astype(float)
    blue, green, red = picture.transpose(2, 0, 1)
    # Blue over cyan and yellow to red, 4 · 254 steps; the line is that which our matchers agree on.
    place = np.where(red == 0, green, 254 + (red + 254 - blue) / 2)
    place = np.where((red >= 254) & (green < 254), 762 - green, place)
    place[picture.sum(axis=2) == 0] = np.nan
    camera = 427.12 * 50 / (198.9 + 1.275 * place)
    return left, right, camera.repeat(2, axis=0).repeat(2, axis=1)


def sgbm(left: np.ndarray, right: np.ndarray, block: int, mode: int) -> np.ndarray:
    penalty = 8 * block**2
    matcher = cv2.StereoSGBM.create(
        0, 128, block, penalty, 4 * penalty, 1, uniquenessRatio=5, mode=mode
    )
    padded = [np.pad(image, ((0, 0), (128, 0)), mode="edge") for image in (left, right)]
    disparity = matcher.compute(*padded)[:, 128:].astype(np.float32) / 16
    return np.where(disparity > 0, disparity, np.nan)


def ours(
    left: np.ndarray, right: np.ndarray, method: Method, block: int, texture: float = 2.0
) -> np.ndarray:
    settings = MatchingSettings(
        method, 128, block, left_band="physical", texture=texture, median=3, quantum=1 / 32,
        left_right=2.0 if method == "ad-census" else 1.0,
    )  # fmt: skip
    return match(left, right, settings)


PAIR_CANDIDATES = {
    "opencv-bm 19": (ours, "opencv-bm", 19),
    "zncc 19": (ours, "zncc", 19),
    "zncc 19, texture 0": (ours, "zncc", 19, 0.0),
    "SGBM 3WAY, 3": (sgbm, 3, cv2.STEREO_SGBM_MODE_SGBM_3WAY),
    "SGBM HH, 7": (sgbm, 7, cv2.STEREO_SGBM_MODE_HH),
    "ad-census": (ours, "ad-census", 19),
}


def measured(name: str) -> tuple[np.ndarray, float]:
    """Return the disparity and processor seconds of a matcher."""
    left, right, _ = real_pair()
    matcher, *options = PAIR_CANDIDATES[name]
    matcher(left[:64, :256], right[:64, :256], *options)
    seconds = []
    for _ in range(3):
        start = time.process_time()
        disparity = matcher(left, right, *options)
        seconds.append(time.process_time() - start)
    return disparity, min(seconds)


PATCHES = [(560, 60), (660, 60), (740, 110), (700, 330), (60, 300), (60, 380), (160, 400)]
PATCHES += [(300, 400), (420, 400), (740, 400), (560, 120), (250, 20), (100, 60)]


def table_of_pair() -> None:
    names = ["matcher", "valid", "median Δ", "> 3 px", "> 1 px near steps", "plane RMS", "seconds"]
    print("| " + " | ".join(names) + " |\n|" + "---|" * len(names))
    camera = real_pair()[2]
    rows = {"the camera": (camera, float("nan"))}
    rows |= {name: measured(name) for name in PAIR_CANDIDATES}
    for name, (disparity, seconds) in rows.items():
        off = np.abs(disparity - camera)
        near = off[np.isfinite(off) & near_steps(camera)]
        off = off[np.isfinite(off)]
        rms, _ = plane_noise(disparity, PATCHES)
        print(
            f"| {name} | {np.isfinite(disparity)[:, 48:].mean():.3f} | {np.median(off):.3f} | "
            f"{(off > 3).mean():.2%} | {(near > 1).mean():.1%} | {rms:.3f} | {seconds:.2f} |"
        )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--threads", type=int, default=1)
    options = parser.parse_args()
    cv2.setNumThreads(options.threads)
    warnings.filterwarnings("ignore", "All-NaN slice")
    table_of_pair()


if __name__ == "__main__":
    main()
