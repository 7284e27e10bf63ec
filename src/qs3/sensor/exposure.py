"""From radiance to the 8-bit grey image that the matcher sees."""

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from jaxtyping import Float, UInt8

from qs3.errors import InputError


@dataclass(frozen=True)
class ExposureSettings:
    """How the imager turns light into grey levels."""

    response: Literal["film", "linear", "gamma"] = "film"
    """``film`` compresses highlights as a film curve does; ``linear`` clips at white; ``gamma``
    is linear to the power of 1/``gamma``."""
    gamma: float = 2.2
    """Exponent of the ``gamma`` response."""
    gain: float = 1.0
    """Factor on the radiance before the response."""
    auto: float = 0.0
    """Auto-exposure: the share of white (0 to 1, before noise) that the 95th percentile of the
    left image's object region is brought to, by one gain for both cameras; 0 is off."""
    psf: float = 0.0
    """Standard deviation in pixels of the lens's Gaussian point-spread function; 0 is none."""
    vignetting: float = 0.0
    """Share of the cos⁴ law by which the image darkens away from the optical axis, 0 to 1."""
    speckle: float = 0.0
    """Shape of the Gamma distribution of mean 1 that multiplies each pixel (coherent speckle and
    photon noise); larger is less, 398.12 as Landau et al. measured; 0 is none."""
    noise: float = 0.0
    """Standard deviation of additive Gaussian noise, in grey levels of 255."""
    offset: float = 0.0
    """Mean of the same, in grey levels of 255."""
    bits: Literal[8, 10] = 8
    """Bits of a pixel."""


def expose(
    radiance: Float[np.ndarray, "h w"],
    settings: ExposureSettings,
    noise: Float[np.ndarray, "h w"] | None = None,
) -> UInt8[np.ndarray, "h w"]:
    """Expose a radiance image to 8 bits.

    NOTE: the released scanner saves Blender's Filmic view transform. ``film`` stands for it with
    the closed form y = x^a/(x^a + c^a), c = 0.18 (middle grey to one half) and a = 0.756, which
    takes the released world grey of 0.0509 to the grey level 71 measured in its sample image.

    Args:
        radiance: Scene radiance, linear.
        settings: Response, gain and the size of the noise.
        noise: Standard normal draws for each pixel; needed where ``settings.noise`` is above 0.

    Raises:
        InputError: for an unknown response, or a gain or noise below zero.
        ValueError: where noise is asked for and no draws are given.

    Example:
        >>> expose(np.array([[0.0, 0.0509, 0.18]]), ExposureSettings()).tolist()
        [[0, 71, 128]]
    """
    if not (0 < settings.gain < math.inf and 0 <= settings.noise < math.inf):
        raise InputError("exposure: gain must be above 0 and noise not below 0")
    light = np.maximum(radiance, 0.0) * settings.gain
    if settings.response == "film":
        powered = light**0.756
        grey = powered / (powered + 0.18**0.756)
    elif settings.response == "linear":
        grey = np.minimum(light, 1.0)
    else:
        raise InputError(f"exposure: no response {settings.response!r}; choose film or linear")
    levels = 255.0 * grey
    if settings.noise > 0:
        if noise is None:
            raise ValueError("noise draws are needed where the noise is above 0")
        levels = levels + settings.noise * noise
    return np.clip(np.rint(levels), 0, 255).astype(np.uint8)
