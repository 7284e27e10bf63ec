"""From radiance to the grey image of 8 or 10 bits that the matcher sees.

In this order: point-spread function, speckle of the projector's own light, gain or
auto-exposure, response, Gamma speckle, Gaussian noise, saturation, rounding. Speckle multiplies
grey levels, as in SAPIEN (after Landau et al.: shape 398.12; noise −0.231 ± 0.83 of 255);
saturation comes last, as a full well's does.
"""

import math
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np
from jaxtyping import Float, Float32, Shaped, UInt8, UInt16

from qs3.checks import Bounds, NotNegative, Positive, check
from qs3.sensor.light import StereoPair
from qs3.sensor.rig import Region, StereoRig

Grey = UInt8[np.ndarray, "h w"] | UInt16[np.ndarray, "h w"]

_PERCENTILE = 95.0
# The film curve: middle grey to one half, and the exponent fitted to the released sample image.
_MIDDLE, _EXPONENT = 0.18, 0.756


@dataclass(frozen=True)
class ExposureSettings:
    """Settings of the imager, from light to grey levels."""

    response: Literal["film", "linear"] = "film"
    """``film`` compresses highlights as a film curve does; ``linear`` clips at white."""
    gain: Positive = 1.0
    """Factor on the radiance before the response, also on what auto-exposure chose."""
    auto: Annotated[float, Bounds(high=1, below=True)] = 0.0
    """Auto-exposure: the share of white (0 to 1, before noise) that the 95th percentile of the
    left image's object region is brought to, by one gain for both cameras; 0 is off."""
    max_gain: NotNegative = 0.0
    """Largest gain that auto-exposure chooses, as a real imager's exposure time is bounded;
    0 is no bound. Without it a dark surface gets as bright an image as a white one."""
    psf: Annotated[float, Bounds(high=20)] = 0.0
    """Standard deviation in pixels of the lens's Gaussian point-spread function; 0 is none."""
    speckle: NotNegative = 0.0
    """Shape of the Gamma distribution of mean 1 that multiplies each pixel (coherent speckle and
    photon noise); larger is less, 398.12 as Landau et al. measured; 0 is none."""
    coherent: NotNegative = 0.0
    """Gamma shape of the speckle on the projector's light alone; takes a second picture without it.
    0 is none."""
    noise: NotNegative = 0.0
    """Standard deviation of additive Gaussian noise, in grey levels of 255."""
    offset: Annotated[float, Bounds(-255, 255)] = 0.0
    """Mean of the additive Gaussian noise, in grey levels of 255."""
    bits: Literal[8, 10] = 8
    """Bits of a pixel."""

    def __post_init__(self) -> None:
        check(self, "exposure")


def expose_pair(
    pair: StereoPair,
    canvas: Region,
    focus: Region,
    rig: StereoRig,
    settings: ExposureSettings,
    rng: np.random.Generator,
) -> tuple[Grey, UInt8[np.ndarray, "h2 w2"] | UInt16[np.ndarray, "h2 w2"]]:
    """Expose the ``canvas`` of both images of a view, left first; auto-exposure uses ``focus``.

    Grey levels, 0…255 or 0…1023, do not depend on the canvas: the lens sees ``blur_reach`` pixels
    more, noise is drawn for whole frames, and the gain follows from ``focus`` alone. Without a
    second camera the right image is empty.
    """
    gain = automatic_gain(pair, focus, rig, settings)
    shape = rig.full_frame.shape

    def side(index: int) -> Grey:
        speckle = noise = None
        if settings.speckle > 0:
            speckle = rng.standard_gamma(settings.speckle, shape, np.float32)[canvas.slices]
            speckle = speckle / np.float32(settings.speckle)
        if settings.noise > 0:
            noise = rng.standard_normal(shape, np.float32)[canvas.slices]
        light = _through_lens(pair, index, canvas, rig, settings)
        if settings.coherent > 0:
            if pair.room is None:
                raise ValueError("coherent speckle needs the picture without the projector's light")
            room = _through_lens(pair.room, index, canvas, rig, settings)
            grains = rng.standard_gamma(settings.coherent, shape, np.float32)[canvas.slices]
            light = room + np.maximum(light - room, 0) * (grains / np.float32(settings.coherent))
        return expose(light, settings, noise, speckle, gain)

    if rig.second == "pattern":
        return side(0), _quantised(np.zeros((0, 0), np.float32), settings)
    return side(0), side(1)


def expose(
    radiance: Float[np.ndarray, "h w"],
    settings: ExposureSettings,
    noise: Float[np.ndarray, "h w"] | None = None,
    speckle: Float[np.ndarray, "h w"] | None = None,
    automatic: float = 1.0,
) -> Grey:
    """Expose one image behind its lens: all that `expose_pair` does but the blur.

    NOTE: the released scanner saves Blender's Filmic view transform. ``film`` stands for it with
    the closed form y = x^a/(x^a + c^a), c = 0.18 (middle grey to one half) and a = 0.756, which
    takes the released world grey of 0.0509 to the grey level 71 measured in its sample image.

    Args:
        radiance: Scene radiance, linear.
        settings: The imager.
        noise: Standard normal draws for each pixel if ``settings.noise`` is above 0.
        speckle: Gamma draws of mean 1 if ``settings.speckle`` is above 0.
        automatic: The gain that auto-exposure chose.

    Example:
        >>> expose(np.array([[0.0, 0.0509, 0.18]]), ExposureSettings()).tolist()
        [[0, 71, 128]]
    """
    light = np.maximum(radiance, 0.0)
    levels = 255.0 * _respond(light * (settings.gain * automatic), settings)
    if speckle is not None:
        levels = levels * speckle
    if noise is not None:
        levels = levels + settings.noise * noise
    if settings.offset:
        levels = levels + settings.offset
    return _quantised(levels, settings)


def automatic_gain(
    pair: StereoPair, focus: Region, rig: StereoRig, settings: ExposureSettings
) -> float:
    """Return the gain that brings the left image's 95th percentile to ``settings.auto``.

    Only pixels of ``focus`` that differ from the background count, or all if none does. A black or
    empty focus leaves the gain at 1, or at ``max_gain`` if set; without ``auto`` it is 1.
    """
    if not settings.auto:
        return 1.0
    bound = settings.max_gain or math.inf
    shown = pair.canvas(focus)[0] != np.float32(pair.background)
    light = _through_lens(pair, 0, focus, rig, settings)
    light = light[shown] if shown.any() else light
    # An order statistic, so that it commutes with the response.
    level = float(np.percentile(light, _PERCENTILE, method="nearest")) if light.size else 0.0
    if level > 0:
        return min(radiance_of(settings.auto, settings) / level, bound)
    return bound if settings.max_gain else 1.0


def radiance_of(share: float, settings: ExposureSettings) -> float:
    """The radiance that the response turns into ``share`` of white: its inverse below 1."""
    if settings.response == "film":
        return _MIDDLE * (share / (1 - share)) ** (1 / _EXPONENT)
    return share


def _respond(light: Shaped[np.ndarray, "h w"], settings: ExposureSettings) -> np.ndarray:
    if settings.response == "film":
        powered = light**_EXPONENT
        return powered / (powered + _MIDDLE**_EXPONENT)
    return light


def _quantised(levels: Float[np.ndarray, "h w"], settings: ExposureSettings) -> Grey:
    if settings.bits == 8:
        return np.clip(np.rint(levels), 0, 255).astype(np.uint8)
    return np.clip(np.rint(levels * (1023 / 255)), 0, 1023).astype(np.uint16)


def _through_lens(
    pair: StereoPair, side: int, part: Region, rig: StereoRig, settings: ExposureSettings
) -> Float32[np.ndarray, "h w"]:
    reach = blur_reach(settings.psf)
    wide = part.grown(reach, rig.width, rig.height) if reach and not part.empty else part
    return blur(pair.canvas(wide)[side], settings.psf)[part.within(wide)]


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
