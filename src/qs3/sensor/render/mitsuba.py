"""The default renderer: Mitsuba 3, on CUDA, LLVM or plain C++, whichever is here.

Only the object's region is rendered, with a shifted principal point and a film whose sides are
multiples of 64 pixels: a film size that changes at every image would compile a kernel each time.
"""

import functools
import os
import subprocess
import sys
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import cv2
import numpy as np
from jaxtyping import Float32

from qs3.errors import InputError
from qs3.sensor.materials import Material
from qs3.sensor.render.cache import CacheSettings
from qs3.sensor.render.embree import EmbreePhotographer
from qs3.sensor.render.jit import JitPhotographer
from qs3.sensor.render.scene import (
    Body,
    LightSettings,
    Scene,
    StereoPair,
    photographed_region,
    refuse_sky,
)
from qs3.sensor.rig import Pose, Region, StereoRig

VARIANTS = ("cuda_ad_mono", "llvm_ad_mono", "scalar_rgb")
_FILM_STEP = 64
_TEXTURE_SIZE = 2048
_SKY_ROWS, _SKY_COLUMNS = 512, 4

# Mitsuba's cameras and projectors look along +z with x to the left and y up.
_OPENCV_TO_MITSUBA = np.diag([-1.0, -1.0, 1.0, 1.0])

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
    """Whether a Mitsuba variant renders here, tried in a child process.

    A system libLLVM that does not suit the processor aborts the whole process, hence the child.
    """
    probe = [sys.executable, "-c", _PROBE, variant]
    try:
        return subprocess.run(probe, capture_output=True, timeout=300).returncode == 0
    except subprocess.TimeoutExpired:
        return False


@functools.cache
def best_variant() -> str:
    """The fastest variant that works here, of ``VARIANTS``.

    Raises:
        InputError: where none does.
    """
    for variant in VARIANTS:
        if usable(variant):
            return variant
    raise InputError("Mitsuba does not render here, not even as scalar_rgb; see: qs3 doctor")


@dataclass(frozen=True)
class MitsubaRenderer:
    """Photographs scenes with Mitsuba 3 (box filter, one bounce of light)."""

    variant: str = ""
    """One of ``VARIANTS``; empty picks the fastest that works here."""
    samples: int = 4
    """Rays a pixel. With cached light the disparity's noise at 4 is within 5 % of that at 64
    (``benchmarks/scan.py``); plain path tracing needs 64 and more."""
    max_depth: int = 3
    """Longest path: 2 is direct light alone, 3 adds one bounce."""
    indirect: Literal["cached", "path"] = "cached"
    """``cached``: the projector's light by the pixel, all other light from an irradiance cache
    (:mod:`qs3.sensor.render.cache`), where every surface is rough; else, and with ``path``, plain
    path tracing, with many times the noise at as many rays."""
    cache_cell: int = 4
    """Side in pixels of a cell of the cache."""
    cache_rays: int = 32
    """Rays over the hemisphere in each cell."""
    full_frame: bool = False
    """Render whole frames in place of the object's region."""

    def __post_init__(self) -> None:
        if not self.variant:
            object.__setattr__(self, "variant", best_variant())
        elif self.variant not in VARIANTS:
            raise InputError(
                f"renderer: no variant {self.variant!r}; choose one of {', '.join(VARIANTS)}"
            )
        elif not usable(self.variant):
            raise InputError(f"renderer: {self.variant} does not work here; see: qs3 doctor")
        if self.samples < 1 or self.max_depth < 2:
            raise InputError("renderer: at least 1 sample and a max_depth of 2 are needed")
        if self.indirect not in ("cached", "path"):
            raise InputError(f"renderer: no indirect {self.indirect!r}; choose cached or path")
        CacheSettings(self.cache_cell, self.cache_rays)  # refuses values that make no sense

    @property
    def description(self) -> dict[str, str]:
        """Name, version and variant, for records."""
        return {"name": "mitsuba", "version": _mitsuba(self.variant).__version__} | {
            "variant": self.variant
        }

    def render(
        self,
        scene: Scene,
        rig: StereoRig,
        poses: Sequence[Pose],
        seeds: Sequence[int],
        regions: Sequence[Region] | None = None,
    ) -> list[StereoPair]:
        """Photograph ``scene`` once from each pose.

        Raises:
            ValueError: where there is not one seed (and region, if given) for each pose.
        """
        if len(poses) != len(seeds) or (regions is not None and len(regions) != len(poses)):
            raise ValueError(f"{len(poses)} poses and {len(seeds)} seeds, or too few regions")
        mi = _mitsuba(self.variant)
        photograph = self._cached(mi, scene) or self._traced(mi, scene)
        pairs = []
        for index, (pose, seed) in enumerate(zip(poses, seeds, strict=True)):
            parts = []
            for side, camera in enumerate((pose, rig.right(pose))):
                if side == 1 and rig.second == "pattern":
                    part = Region(0, 0, 0, 0)
                elif self.full_frame:
                    part = rig.full_frame
                elif regions is not None:
                    part = regions[index]
                else:
                    part = photographed_region(scene, rig, camera)
                parts.append(part)
            if parts[0] != rig.full_frame and scene.alone:
                refuse_sky(rig, pose, scene.light)
            left, right = photograph(rig, pose, (parts[0], parts[1]), seed)
            background = scene.light.ambient
            pairs.append(StereoPair(left, right, parts[0], parts[1], background, pose))
        return pairs

    def _cached(self, mi: Any, scene: Scene) -> "_Photograph | None":
        """Photographing with an irradiance cache, where the scene allows it."""
        materials = [body.material for body in scene.bodies]
        plain = self.variant.startswith("scalar")
        allowed = all(m.model == "diffuse" if plain else m.rough for m in materials)
        if self.indirect == "path" or not allowed:
            return None
        cache = CacheSettings(self.cache_cell, self.cache_rays)
        if plain:
            photographer = EmbreePhotographer(scene, self.max_depth)
        else:
            bodies = {f"body{i}": _mesh(mi, body) for i, body in enumerate(scene.bodies)}
            shapes = mi.load_dict({"type": "scene", **bodies})
            photographer = JitPhotographer(mi, scene, shapes, self.max_depth)

        def photograph(
            rig: StereoRig, pose: Pose, regions: tuple[Region, Region], seed: int
        ) -> list[Float32[np.ndarray, "_ _"]]:
            return photographer.photograph(rig, pose, regions, self.samples, cache, seed)

        return photograph

    def _traced(self, mi: Any, scene: Scene) -> "_Photograph":
        """Photographing with Mitsuba's path integrator."""
        built = _build(mi, scene, self.max_depth)
        parameters = mi.traverse(built)
        transform = mi.ScalarTransform4f if self.variant.startswith("scalar") else mi.Transform4f

        def photograph(
            rig: StereoRig, pose: Pose, regions: tuple[Region, Region], seed: int
        ) -> list[Float32[np.ndarray, "_ _"]]:
            parameters["projector.to_world"] = transform(_to_world(rig.projector(pose)))
            parameters.update()
            # Two streams that never meet: the left camera's seeds are even.
            return [
                _photograph(mi, built, rig, camera, region, self.samples, (2 * seed + side) % 2**32)
                for side, (camera, region) in enumerate(
                    zip((pose, rig.right(pose)), regions, strict=True)
                )
            ]

        return photograph


_Photograph = Callable[
    [StereoRig, Pose, tuple[Region, Region], int], list[Float32[np.ndarray, "_ _"]]
]


def _mitsuba(variant: str) -> Any:
    """Import Mitsuba with ``variant`` set, whichever was set before."""
    import mitsuba as mi

    if mi.variant() != variant:
        mi.set_variant(variant)
        mi.set_log_level(mi.LogLevel.Error)
        threads = os.environ.get("OMP_NUM_THREADS", "")
        if threads.isdigit() and int(threads):  # Dr.Jit does not look at it
            import drjit as dr

            dr.set_thread_count(int(threads))
    return mi


def _to_world(pose: Pose) -> list[list[float]]:
    return (pose.camera_to_world @ _OPENCV_TO_MITSUBA).tolist()


def _build(mi: Any, scene: Scene, max_depth: int) -> Any:
    extent = np.degrees(2 * np.arctan(scene.tan_half_width))
    bodies = {f"body{i}": _mesh(mi, body) for i, body in enumerate(scene.bodies)}
    glass = any(body.material.model == "glass" for body in scene.bodies)
    return mi.load_dict(
        {
            "type": "scene",
            # Light passes panes of thin glass, shadow rays as well, and no pane counts as a bounce:
            # the volumetric integrator does so; the plain one leaves what is behind glass dark.
            "integrator": {"type": "volpath" if glass else "path", "max_depth": max_depth},
            **bodies,
            "projector": {
                "type": "projector",
                "fov": float(extent),
                "irradiance": {
                    "type": "bitmap",
                    "bitmap": mi.Bitmap(_texture(scene)[..., None]),
                    "raw": True,
                    "wrap_mode": "clamp",
                },
                "scale": scene.light.projector,
            },
            "sky": {
                "type": "envmap",
                # Of the two lights the projector, a point, is found by light sampling alone; the
                # sky is found as well by following the surface's own scattering. Measured: as
                # many rays give 0.14 px of disparity noise in place of 0.18.
                "sampling_weight": 0.02,
                "bitmap": mi.Bitmap(_sky(scene.light)),
                "to_world": mi.ScalarTransform4f().rotate([1, 0, 0], 90),
            },
        }
    )


def _mesh(mi: Any, body: Body) -> Any:
    properties = mi.Properties()
    properties["mesh_bsdf"] = mi.load_dict(_bsdf(body.material))
    mesh = body.mesh
    built = mi.Mesh("body", len(mesh.vertices), len(mesh.faces), props=properties)
    parameters = mi.traverse(built)
    parameters["vertex_positions"] = np.asarray(mesh.vertices, dtype=np.float32).ravel()
    parameters["faces"] = np.asarray(mesh.faces, dtype=np.uint32).ravel()
    parameters.update()
    return built


def _bsdf(material: Material) -> dict[str, Any]:
    """The material in Mitsuba's terms; two-sided, as artists' meshes have faces of either winding.

    NOTE: glass is thin (no refraction inside), because meshes of CAD collections are rarely closed.
    """
    colour = {"type": "rgb", "value": [material.albedo] * 3}
    if material.model == "glass":
        return {"type": "thindielectric", "int_ior": material.ior}
    surface: dict[str, Any]
    if material.model == "diffuse":
        surface = {"type": "diffuse", "reflectance": colour}
    elif material.model == "mirror":
        surface = {"type": "conductor", "material": "none", "specular_reflectance": colour}
    else:
        surface = {
            "type": "principled",
            "base_color": colour,
            "roughness": material.roughness,
            "metallic": material.metallic,
            "eta": material.ior,
        }
    return {"type": "twosided", "material": surface}


def _texture(scene: Scene) -> Float32[np.ndarray, "h w"]:
    """The pattern in square texels: a projector of Mitsuba takes its shape from its picture's.

    NOTE: Mitsuba's projector lights a screen evenly, so that its intensity grows by 1/cos³ off the
    axis; a spot light through a slide, as Blender has it, and a laser's spots do not. Hence cos³.
    """
    height = max(1, round(_TEXTURE_SIZE * scene.tan_half_height / scene.tan_half_width))
    image = cv2.resize(scene.pattern, (_TEXTURE_SIZE, height), interpolation=cv2.INTER_LINEAR)
    x = (2 * (np.arange(_TEXTURE_SIZE) + 0.5) / _TEXTURE_SIZE - 1) * scene.tan_half_width
    y = (2 * (np.arange(height) + 0.5) / height - 1) * scene.tan_half_height
    squared = 1 + x[None, :] ** 2 + y[:, None] ** 2
    return (image / squared**1.5).astype(np.float32)


def _sky(light: LightSettings) -> Float32[np.ndarray, "h w c"]:
    """Sky over ground as a latitude-longitude picture, the zenith at the top."""
    elevation = 90.0 - 180.0 * (np.arange(_SKY_ROWS) + 0.5) / _SKY_ROWS
    radiance = np.where(elevation > light.sky_elevation, light.sky, 0.0) + light.ambient
    image = np.broadcast_to(radiance[:, None, None], (_SKY_ROWS, _SKY_COLUMNS, 3))
    return np.ascontiguousarray(image, dtype=np.float32)


def _photograph(
    mi: Any, scene: Any, rig: StereoRig, camera: Pose, region: Region, samples: int, seed: int
) -> Float32[np.ndarray, "h w"]:
    """Render one region of one camera's frame."""
    if not region.width or not region.height:
        return np.zeros((region.height, region.width), dtype=np.float32)
    width = -(-region.width // _FILM_STEP) * _FILM_STEP
    height = -(-region.height // _FILM_STEP) * _FILM_STEP
    cx, cy = rig.principal_point
    # Shift of the film from the optical axis, as a share of the film.
    shift_x = ((width - 1) / 2 + region.x - cx) / width
    shift_y = ((height - 1) / 2 + region.y - cy) / height
    sensor = mi.load_dict(
        {
            "type": "perspective",
            "fov": float(np.degrees(2 * np.arctan(width / 2 / rig.focal))),
            "fov_axis": "x",
            "near_clip": 1e-2,
            "far_clip": 1e3,
            "principal_point_offset_x": float(shift_x),
            "principal_point_offset_y": float(shift_y),
            "to_world": mi.ScalarTransform4f(_to_world(camera)),
            "film": {
                "type": "hdrfilm",
                "width": width,
                "height": height,
                "pixel_format": "luminance",
                "component_format": "float32",
                "rfilter": {"type": "box"},
            },
            "sampler": {"type": "independent", "sample_count": samples},
        }
    )
    image = np.array(mi.render(scene, sensor=sensor, seed=seed, spp=samples), dtype=np.float32)
    return np.ascontiguousarray(image[: region.height, : region.width, 0])
