"""The matchers on a real infrared pair beside the camera's own depth: a table of docs/sensors.md.

The D435's in `ir` of the folder that QS3_SHARED_DATA names, 848 × 480, f 427.12 px, b 50 mm,
128 disparities. Valid pixels right of column 48; median of the differences from the camera, the
share above 3 px, and that above 1 px where the camera's disparity differs by 4 px within 8 px; how
far the box reaches beyond its upper and slanted right edge (median, 10 and 90 %, px) and the bottle
beyond the camera's left and right end (medians, px); RMS on 13 patches of floor and box after a
plane is taken off, and its autocorrelation along x; processor seconds of one match, the least of
three, and the most MiB that it holds beyond what is held before it.

    python benchmarks/matching.py [--picture pair.png] [--threads 1]
"""

import argparse
import ctypes
import multiprocessing
import os
import time
import warnings
from pathlib import Path

import cv2
import numpy as np

from qs3.sensor.matching import MatchingSettings, match
from qs3.sensor.matching.settings import Method
from qs3.sensor.realism.pair import near_steps, plane_noise


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


def measured(name: str, threads: int) -> tuple[np.ndarray, float, float]:
    """Disparity, processor seconds and MiB; in a process of its own."""
    cv2.setNumThreads(threads)
    left, right, _ = real_pair()
    matcher, *options = PAIR_CANDIDATES[name]
    matcher(left[:64, :256], right[:64, :256], *options)
    ctypes.CDLL(None).malloc_trim(0)  # what imports have left would be taken first, and not counted
    Path("/proc/self/clear_refs").write_text("5")  # the most that was held begins anew
    before = most_held()
    seconds = []
    for _ in range(3):
        start = time.process_time()
        disparity = matcher(left, right, *options)
        seconds.append(time.process_time() - start)
    return disparity, min(seconds), most_held() - before


def most_held() -> float:
    """The most memory that this process has held, in MiB."""
    status = Path("/proc/self/status").read_text()
    return int(status.split("VmHWM:")[1].split()[0]) / 1024


def spill(disparity: np.ndarray) -> list[str]:
    """How far the box reaches up and to the right beyond the edges that the left image shows."""
    up, right = [], []
    for x in range(190, 364, 2):
        edge = round(176.1 - 0.244 * x)
        box = np.nanmedian(disparity[edge + 6 : edge + 26, x])
        floor = np.nanmedian(disparity[edge - 60 : edge - 35, x])
        near = disparity[edge - 30 : edge + 10, x] > (box + floor) / 2
        up.append(30 - near.argmax())
    for y in range(100, 176, 2):
        edge = round(316.4 + 0.749 * y)
        box = np.nanmedian(disparity[y, edge - 28 : edge - 8])
        floor = np.nanmedian(disparity[y, edge + 31 : edge + 46])
        near = disparity[y, edge - 16 : edge + 30] > (box + floor) / 2
        right.append(30 - near[::-1].argmax())
    quantiles = (np.quantile(side, (0.5, 0.1, 0.9)) for side in (up, right))
    return [f"{middle:+.0f} [{low:.0f} {high:.0f}]" for middle, low, high in quantiles]


def bottle(disparity: np.ndarray) -> np.ndarray:
    """Median of the first and last column that is 4 px nearer than the floor beside it."""
    rows = disparity[44:130]
    floor = np.nanmedian(np.hstack([rows[:, 400:425], rows[:, 520:545]]), axis=1)
    near = rows[:, 425:520] > floor[:, None] + 4
    near = near[near.any(axis=1)]
    return np.median([near.argmax(axis=1), 94 - near[:, ::-1].argmax(axis=1)], axis=1)


PATCHES = [(560, 60), (660, 60), (740, 110), (700, 330), (60, 300), (60, 380), (160, 400)]
PATCHES += [(300, 400), (420, 400), (740, 400), (560, 120), (250, 20), (100, 60)]


def coloured(disparity: np.ndarray) -> np.ndarray:
    levels = np.nan_to_num((disparity - 20) / 40 * 255).clip(0, 255).astype(np.uint8)
    picture = cv2.applyColorMap(levels, cv2.COLORMAP_TURBO)
    picture[~np.isfinite(disparity)] = 0
    return picture


def table_of_pair(threads: int, picture: Path | None) -> None:
    names = ["matcher", "valid", "median Δ", "> 3 px", "> 1 px near steps", "box up", "box right"]
    names += ["bottle left", "bottle right", "plane RMS", "autocorrelation at 1, 4, 8", "seconds"]
    names += ["MiB"]
    print("| " + " | ".join(names) + " |\n|" + "---|" * len(names))
    camera = real_pair()[2]
    rows = {"the camera": (camera, float("nan"), float("nan"))}
    for name in PAIR_CANDIDATES:
        with multiprocessing.get_context("spawn").Pool(1) as pool:
            rows[name] = pool.apply(measured, (name, threads))
    for name, (disparity, seconds, memory) in rows.items():
        off = np.abs(disparity - camera)
        near = off[np.isfinite(off) & near_steps(camera)]
        off = off[np.isfinite(off)]
        (up, right), (rms, along) = spill(disparity), plane_noise(disparity, PATCHES)
        ends = bottle(disparity) - bottle(camera)
        cells = [f"{rms:.3f}", " ".join(f"{r:.2f}" for r in along), f"{seconds:.2f}"]
        print(
            f"| {name} | {np.isfinite(disparity)[:, 48:].mean():.3f} | {np.median(off):.3f} | "
            f"{(off > 3).mean():.2%} | {(near > 1).mean():.1%} | {up} | {right} | "
            f"{-ends[0]:+.0f} | {ends[1]:+.0f} | {' | '.join(cells)} | {memory:.0f} |"
        )
    if picture is not None:
        panels = [coloured(rows[name][0]) for name in ("the camera", "ad-census", "zncc 19")]
        cv2.imwrite(str(picture), np.hstack(panels))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--picture", type=Path, help="of the camera's depth, ad-census and zncc")
    parser.add_argument("--threads", type=int, default=1)
    options = parser.parse_args()
    cv2.setNumThreads(options.threads)
    warnings.filterwarnings("ignore", "All-NaN slice")
    table_of_pair(options.threads, options.picture)


if __name__ == "__main__":
    main()
