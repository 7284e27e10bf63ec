"""The matchers on synthetic dots of known shift: error, bias, pixel locking and time.

Gaussian dots at random sub-pixel places, the right image the same dots moved left by 20 to 21 px in
steps of 1/16, grey noise added to both, 8 bits, 64 disparities, thresholds as by default. The
figures are over all pixels away from the border: total RMS and bias of the errors below 1 px,
locking (half the range of the mean error over the fractional shifts), outliers (errors of 1 px and
above) and valid pixels as shares; then the least seconds of three for one pair as a scan of the
`paper` sensor matches it, 760 × 520 pixels and 160 disparities.

    python benchmarks/matching.py [--density 0.025] [--sigma 0.8] [--threads 1]
"""

import argparse
import time
from typing import Literal

import cv2
import numpy as np

from qs3.sensor.matching import MatchingSettings, match

CANDIDATES: list[tuple[Literal["opencv-bm", "zncc"], int, bool]] = [
    ("opencv-bm", 15, False),
    ("opencv-bm", 15, True),
    ("opencv-bm", 19, True),
    ("opencv-bm", 21, True),
    ("zncc", 9, False),
    ("zncc", 11, False),
    ("zncc", 15, False),
    ("zncc", 19, False),
    ("zncc", 21, False),
]
SHIFTS = np.arange(20, 21, 1 / 16)


def dots(
    shape: tuple[int, int], shift: float, density: float, sigma: float, seed: int
) -> tuple[np.ndarray, np.ndarray]:
    """Grey levels, not rounded, of Gaussian dots and of the same moved left by ``shift``."""
    rng = np.random.default_rng(seed)
    height, width = shape
    count = int(density * height * (width + 64))
    rows, columns = rng.uniform(0, height, count), rng.uniform(0, width + 64, count)
    bright = rng.uniform(100, 160, count)
    around = np.arange(-5, 6)
    images = []
    for centre in (columns, columns - shift):
        image = np.full((height + 10, width + 74), 40.0)
        y, x = np.rint(rows).astype(int), np.rint(centre).astype(int)
        across = np.exp(-((x[:, None] + around - centre[:, None]) ** 2) / (2 * sigma**2))
        down = np.exp(-((y[:, None] + around - rows[:, None]) ** 2) / (2 * sigma**2))
        spot = bright[:, None, None] * down[:, :, None] * across[:, None, :]
        at_y = np.clip(y[:, None, None] + around[:, None] + 5, 0, height + 9)
        at_x = np.clip(x[:, None, None] + around + 5, 0, width + 73)
        np.add.at(image, (at_y, at_x), spot)
        images.append(image[5 : 5 + height, 5 : 5 + width])
    return images[0], images[1]


def grey(image: np.ndarray, noise: float, rng: np.random.Generator) -> np.ndarray:
    noisy = image + noise * rng.standard_normal(image.shape)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--density", type=float, default=0.025, help="dots a pixel")
    parser.add_argument("--sigma", type=float, default=0.8, help="of a dot, in pixels")
    parser.add_argument("--threads", type=int, default=cv2.getNumThreads())
    options = parser.parse_args()
    cv2.setNumThreads(options.threads)
    print(f"{options.threads} threads")
    names = ["method", "block", "noise", "RMS", "bias", "locking", "outliers", "valid", "seconds"]
    print("| " + " | ".join(names) + " |\n|" + "---|" * len(names))
    pairs = [dots((160, 360), s, options.density, options.sigma, seed=0) for s in SHIFTS]
    big = [
        grey(image, 3.0, np.random.default_rng(0))
        for image in dots((520, 760), 40.3, options.density, options.sigma, seed=1)
    ]
    for method, block, corrected in CANDIDATES:
        settings = MatchingSettings(method, 64, block, corrected)
        large = MatchingSettings(method, 160, block, corrected)
        seconds = []
        for _ in range(3):
            start = time.perf_counter()
            match(big[0], big[1], large)
            seconds.append(time.perf_counter() - start)
        for noise in (0.0, 3.0):
            rng = np.random.default_rng(2)
            errors = np.stack(
                [
                    match(grey(a, noise, rng), grey(b, noise, rng), settings)[20:-20, 90:-20]
                    - shift
                    for (a, b), shift in zip(pairs, SHIFTS, strict=True)
                ]
            )
            near = np.where(np.abs(errors) < 1, errors, np.nan)
            means = np.nanmean(near, axis=(1, 2))
            valid = np.isfinite(errors)
            name = method + (" − 1/32" if corrected else "")
            print(
                f"| {name} | {block} | {noise:.0f} | {np.sqrt(np.nanmean(near**2)):.3f} | "
                f"{np.nanmean(near):+.3f} | {np.ptp(means) / 2:.3f} | "
                f"{(np.abs(errors[valid]) >= 1).mean():.2%} | {valid.mean():.1%} | "
                f"{min(seconds):.3f} |"
            )


if __name__ == "__main__":
    main()
