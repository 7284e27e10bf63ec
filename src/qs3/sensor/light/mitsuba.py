"""The default renderer: Mitsuba 3, on CUDA, LLVM or plain C++, whichever is here."""

import ctypes.util
import functools
import gc
import importlib.metadata
import os
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

from qs3.checks import Bounds, check
from qs3.errors import InputError, no_such, say_once
from qs3.processors import wanted_threads
from qs3.sensor.light import MOST_SAMPLES, Scene, StereoPair, view_regions
from qs3.sensor.light.cache import Photographer
from qs3.sensor.light.embree import EmbreePhotographer
from qs3.sensor.light.jit import JitPhotographer
from qs3.sensor.light.path import PathPhotographer
from qs3.sensor.rig import Pose, Region, StereoRig

VARIANTS = ("cuda_ad_mono", "llvm_ad_mono", "scalar_rgb")

_CACHED_SAMPLES, _PATH_SAMPLES = 4, 256  # rays per pixel
_COAT_RAYS = 16  # times the rays of a cell for a surface that is all coat: metal

_PROBE = """
import sys
import mitsuba as mi
mi.set_variant(sys.argv[1])
scene = mi.load_dict({
    "type": "scene",
    "integrator": {"type": "path"},
    "shape": {"type": "sphere"},
    "light": {"type": "constant"},
    "sensor": {"type": "perspective", "film": {"type": "hdrfilm", "width": 4, "height": 4}},
})
mi.render(scene, spp=1)
"""


@functools.cache
def usable(variant: str) -> bool:
    """Return whether a Mitsuba variant renders here, tried in a child process.

    A libLLVM that does not suit the processor aborts the whole process, hence the child.
    """
    point_to_llvm()
    probe = [sys.executable, "-c", _PROBE, variant]
    try:
        return subprocess.run(probe, capture_output=True, timeout=300).returncode == 0
    except subprocess.TimeoutExpired:
        return False


@functools.cache
def best_variant() -> str:
    """The fastest variant that works here, of ``VARIANTS``."""
    variant = next(filter(usable, VARIANTS), None)
    if variant is None:
        raise InputError("Mitsuba does not render here, not even as scalar_rgb; see: qs3 doctor")
    return variant


@dataclass(frozen=True)
class MitsubaRenderer:
    """Photographs scenes with Mitsuba 3 (box filter, one bounce of light)."""

    variant: str = field(default_factory=best_variant)
    """One of ``VARIANTS``; default: the fastest that works here."""
    samples: Annotated[int | None, Bounds(1, MOST_SAMPLES)] = None
    """Rays per pixel; default: 4 with cached light, where noise of disparity and valid pixels are
    as with 64 times as many, to 10 % (``benchmarks/light.py``), and 256 with path tracing."""
    max_depth: Annotated[int, Bounds(2, 128)] = 3
    """Longest path: 2 is direct light alone, 3 adds one bounce."""
    indirect: Literal["cached", "path"] = "cached"
    """``cached``: the projector's light by the pixel, all other light from an irradiance cache
    (:mod:`qs3.sensor.light.cache`). A scene with a mirror or glass is path-traced, with 256 rays
    per pixel at least. ``path``: all light by path tracing, with ``samples`` as they are."""
    cache_cell: Annotated[int, Bounds(1, 4096)] = 4
    """Side in pixels of a cell of the cache."""
    cache_rays: Annotated[int, Bounds(1, 4096)] = 32
    """Rays over the hemisphere in each cell; up to 16 times as many if a body is of metal."""
    full_frame: bool = False
    """Render whole frames, not the object's region."""

    def __post_init__(self) -> None:
        if self.variant not in VARIANTS:
            raise no_such(f"renderer: no variant {self.variant!r}", self.variant, VARIANTS)
        if not usable(self.variant):
            raise InputError(f"renderer: {self.variant} does not work here; see: qs3 doctor")
        check(self, "renderer")

    @property
    def rays(self) -> int:
        """Rays per pixel: ``samples``, or as many as the light needs."""
        usual = _PATH_SAMPLES if self.indirect == "path" else _CACHED_SAMPLES
        return usual if self.samples is None else self.samples

    @property
    def description(self) -> dict[str, Any]:
        """Name, version, variant and rays per pixel, for records."""
        version = _mitsuba(self.variant).__version__
        return {
            "name": "mitsuba",
            "version": version,
            "variant": self.variant,
            "samples": self.rays,
        }

    def render(
        self,
        scene: Scene,
        rig: StereoRig,
        poses: Sequence[Pose],
        seeds: Sequence[int],
        regions: Sequence[Region] | None = None,
    ) -> list[StereoPair]:
        """Photograph ``scene`` once from each pose: `qs3.sensor.light.Renderer`."""
        views = view_regions(scene, rig, poses, seeds, regions, self.full_frame)
        pairs = []
        with _collected_later():
            photographer = self._photographer(_mitsuba(self.variant), scene)
            for pose, seed, parts in zip(poses, seeds, views, strict=True):
                left, right = photographer.photograph(rig, pose, parts, seed)
                pairs.append(StereoPair(left, right, *parts, scene.light.ambient, pose))
        return pairs

    def _photographer(self, mi: Any, scene: Scene) -> Photographer | PathPhotographer:
        samples = self.rays
        materials = [body.material for body in scene.bodies]
        if self.indirect == "path":
            return PathPhotographer(mi, scene, samples, self.max_depth)
        if not all(material.rough for material in materials):
            if samples < _PATH_SAMPLES:
                say_once(
                    f"mirror and glass are path-traced, with {_PATH_SAMPLES} rays per pixel in "
                    f"place of {samples}: fewer would add noise that no sensor has"
                )
            return PathPhotographer(mi, scene, max(samples, _PATH_SAMPLES), self.max_depth)
        # A lobe gathers from few places, of which the projector's dots are a few bright ones.
        share = max(1.0, _COAT_RAYS * max(material.coat for material in materials))
        settings = samples, self.max_depth, self.cache_cell, round(share * self.cache_rays)
        if self.variant.startswith("scalar"):
            return EmbreePhotographer(scene, *settings)
        return JitPhotographer(mi, scene, *settings)


@contextmanager
def _collected_later() -> Iterator[None]:
    """Pause the garbage collector: Dr.Jit aborts if a scene is freed during a kernel's trace."""
    running = gc.isenabled()
    gc.disable()
    try:
        yield
    finally:
        if running:
            gc.enable()


def _mitsuba(variant: str) -> Any:
    point_to_llvm()
    import mitsuba as mi

    if mi.variant() != variant:
        mi.set_variant(variant)
        mi.set_log_level(mi.LogLevel.Error)
        if threads := wanted_threads():  # Dr.Jit does not look for it
            import drjit as dr

            dr.set_thread_count(threads)
    return mi


_VARIABLE = "DRJIT_LIBLLVM_PATH"
_WHEEL = "karellen-llvm-core"


@functools.cache
def find_llvm() -> str | None:
    """Return the library that Dr.Jit is to load, or None for its own search.

    In this order: the variable ``DRJIT_LIBLLVM_PATH``; the system's libLLVM 19; the library of the
    wheel that the extra ``llvm`` installs. Other versions of the system are not trusted: 14 and 15
    abort the process on some processors.
    """
    if _VARIABLE in os.environ:
        return os.environ[_VARIABLE] or None
    if ctypes.util.find_library("LLVM-19"):
        return None
    try:
        files = importlib.metadata.files(_WHEEL) or []
    except importlib.metadata.PackageNotFoundError:
        return None
    library = next((file for file in files if file.name.startswith("libLLVM.so")), None)
    path = None if library is None else Path(str(library.locate())).resolve()
    return str(path) if path is not None and path.is_file() else None


def point_to_llvm() -> None:
    """Set ``DRJIT_LIBLLVM_PATH`` for this process and its children, before Dr.Jit is loaded."""
    if path := find_llvm():
        os.environ.setdefault(_VARIABLE, path)
