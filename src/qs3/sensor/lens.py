"""The blur of the lens, before the imager counts the light."""

import math

import numpy as np
from jaxtyping import Float, Float32


def blur_reach(psf: float) -> int:
    """Pixels that a point-spread function of this standard deviation reaches."""
    return math.ceil(4 * psf) + 2 if psf > 0 else 0


def blur_kernel(psf: float) -> Float[np.ndarray, "n"]:
    """Return the discrete Gaussian exp(−t)·Iₙ(t), t = psf²: sum 1, variance ``psf``² in pixels.

    A sampled Gaussian has neither below one pixel (Lindeberg, Scale-space for discrete signals,
    1990). Cut at `blur_reach`, with less than 10⁻³ of its variance lost.
    """
    from scipy.special import ive

    reach = blur_reach(psf)
    kernel = ive(np.abs(np.arange(-reach, reach + 1)), psf**2)
    return kernel / kernel.sum()


def blur(light: Float32[np.ndarray, "h w"], psf: float) -> Float32[np.ndarray, "h w"]:
    """Blur an image by ``psf`` pixels, 0 or more; its borders are replicated.

    Each pixel is the same sum in the same order, so that equal neighbourhoods give equal bits:
    filters of image libraries round differently at their ends.
    """
    if psf == 0 or not light.size:
        return light
    kernel = blur_kernel(psf).astype(np.float32)
    reach = len(kernel) // 2
    for axis, size in enumerate(light.shape):
        wide = np.pad(light, [(reach, reach) if a == axis else (0, 0) for a in (0, 1)], "edge")
        cut = [slice(n, n + size) for n in range(len(kernel))]
        taps = [wide[c] if axis == 0 else wide[:, c] for c in cut]
        light = kernel[reach] * taps[reach]
        for step in range(1, reach + 1):
            light += kernel[reach + step] * (taps[reach - step] + taps[reach + step])
    return light
