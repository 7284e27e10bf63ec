"""Plain path tracing with Mitsuba, and a scene's bodies in its terms.

Only the object's region is rendered, with a shifted principal point and a film whose sides are
multiples of 64 pixels: a film size that changes at every image would compile a kernel each time.
"""

from typing import Any

import cv2
import numpy as np
from jaxtyping import Float32

from qs3.sensor.light import Body, LightSettings, Scene
from qs3.sensor.light.materials import Material
from qs3.sensor.rig import Pose, Region, StereoRig

_FILM_STEP = 64
_TEXTURE_SIZE = 2048
_SKY_ROWS, _SKY_COLUMNS = 512, 4

# Mitsuba's cameras and projectors look along +z with x to the left and y up.
_OPENCV_TO_MITSUBA = np.diag([-1.0, -1.0, 1.0, 1.0])


class PathPhotographer:
    """Photographs one scene with Mitsuba's path integrator."""

    def __init__(self, mi: Any, scene: Scene, samples: int, max_depth: int) -> None:
        self._mi, self._samples = mi, samples
        self._scene = _build(mi, scene, max_depth)
        self._parameters = mi.traverse(self._scene)

    def photograph(
        self, rig: StereoRig, pose: Pose, regions: tuple[Region, Region], seed: int
    ) -> list[Float32[np.ndarray, "_ _"]]:
        """Radiance in the two regions of the pair at ``pose``; an empty region stays empty."""
        mi = self._mi
        scalar = mi.variant().startswith("scalar")
        transform = mi.ScalarTransform4f if scalar else mi.Transform4f
        self._parameters["projector.to_world"] = transform(_to_world(rig.projector(pose)))
        self._parameters.update()
        # Two streams that never meet: the left camera's seeds are even.
        return [
            self._image(rig, camera, region, (2 * seed + side) % 2**32)
            for side, camera, region in zip((0, 1), (pose, rig.right(pose)), regions, strict=True)
        ]

    def _image(
        self, rig: StereoRig, camera: Pose, region: Region, seed: int
    ) -> Float32[np.ndarray, "h w"]:
        if region.empty:
            return np.zeros(region.shape, dtype=np.float32)
        width, height = (-(-side // _FILM_STEP) * _FILM_STEP for side in region.shape[::-1])
        cx, cy = rig.principal_point
        # Shift of the film from the optical axis, as a share of the film.
        shift_x = ((width - 1) / 2 + region.x - cx) / width
        shift_y = ((height - 1) / 2 + region.y - cy) / height
        sensor = self._mi.load_dict(
            {
                "type": "perspective",
                "fov": float(np.degrees(2 * np.arctan(width / 2 / rig.focal))),
                "fov_axis": "x",
                "near_clip": 1e-2,
                "far_clip": 1e3,
                "principal_point_offset_x": float(shift_x),
                "principal_point_offset_y": float(shift_y),
                "to_world": self._mi.ScalarTransform4f(_to_world(camera)),
                "film": {
                    "type": "hdrfilm",
                    "width": width,
                    "height": height,
                    "pixel_format": "luminance",
                    "component_format": "float32",
                    "rfilter": {"type": "box"},
                },
                "sampler": {"type": "independent", "sample_count": self._samples},
            }
        )
        image = self._mi.render(self._scene, sensor=sensor, seed=seed, spp=self._samples)
        image = np.array(image, dtype=np.float32)
        return np.ascontiguousarray(image[: region.height, : region.width, 0])


def mitsuba_bodies(mi: Any, scene: Scene) -> dict[str, Any]:
    """The scene's surfaces, for a scene of Mitsuba."""
    return {f"body{index}": _mesh(mi, body) for index, body in enumerate(scene.bodies)}


def _to_world(pose: Pose) -> list[list[float]]:
    return (pose.camera_to_world @ _OPENCV_TO_MITSUBA).tolist()


def _build(mi: Any, scene: Scene, max_depth: int) -> Any:
    extent = np.degrees(2 * np.arctan(scene.tan_half_width))
    glass = any(body.material.model == "glass" for body in scene.bodies)
    return mi.load_dict(
        {
            "type": "scene",
            # Light passes panes of thin glass, shadow rays as well, and no pane counts as a bounce:
            # the volumetric integrator does so; the plain one leaves what is behind glass dark.
            "integrator": {"type": "volpath" if glass else "path", "max_depth": max_depth},
            **mitsuba_bodies(mi, scene),
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
    # No fewer texels than the pattern has either way: the cache sees all of them.
    shape, aspect = scene.pattern.shape, scene.tan_half_width / scene.tan_half_height
    width = max(_TEXTURE_SIZE, shape[1], round(shape[0] * aspect))
    height = max(1, round(width / aspect))
    image = cv2.resize(scene.pattern, (width, height), interpolation=cv2.INTER_LINEAR)
    x = (2 * (np.arange(width) + 0.5) / width - 1) * scene.tan_half_width
    y = (2 * (np.arange(height) + 0.5) / height - 1) * scene.tan_half_height
    squared = 1 + x[None, :] ** 2 + y[:, None] ** 2
    return (image / squared**1.5).astype(np.float32)


def _sky(light: LightSettings) -> Float32[np.ndarray, "h w c"]:
    elevation = 90.0 - 180.0 * (np.arange(_SKY_ROWS) + 0.5) / _SKY_ROWS
    radiance = np.where(elevation > light.sky_elevation, light.sky, 0.0) + light.ambient
    image = np.broadcast_to(radiance[:, None, None], (_SKY_ROWS, _SKY_COLUMNS, 3))
    return np.ascontiguousarray(image, dtype=np.float32)
