"""Cycles renderer in its own process; started by ``cycles.py``, never imported.

The only file with ``bpy``. It runs in Blender's Python or any Python with ``bpy``, so it uses only
the standard library, NumPy and ``bpy``. It renders the request in its folder, writes arrays and
an answer there, and ends; it ends at once if the standard input does.
"""

import json
import math
import os
import shutil
import sys
import threading
import warnings
from pathlib import Path

# The folder of this file holds modules whose names must not hide installed packages.
_HERE = Path(__file__).resolve().parent
sys.path[:] = [folder for folder in sys.path if Path(folder).resolve() != _HERE]

import numpy as np  # noqa: E402

TOUCH = 1.5e-4  # Mitsuba's rays start so far from an object of size 1
# OpenCV's camera (x right, y down, z forward) in terms of Blender's (x right, y up, z backward).
_TO_BLENDER = np.diag([1.0, -1.0, -1.0, 1.0])


def main():
    """Render the request in the folder that the last argument names."""
    folder = Path(sys.argv[-1])
    threading.Thread(target=_leave_with_the_parent, args=(folder,), daemon=True).start()
    warnings.simplefilter("ignore", DeprecationWarning)
    import bpy  # pyright: ignore[reportMissingImports]

    version = bpy.app.version_string
    if tuple(int(part) for part in version.split()[0].split(".")[:2]) < (4, 2):
        raise RuntimeError(f"Blender {version} is too old: 4.2 or newer is needed")
    answer = {"blender": version, "python": sys.version.split()[0]}
    request = json.loads((folder / "request.json").read_text())
    if request:
        studio = Studio(bpy, folder, request)
        for index, shot in enumerate(request["shots"]):
            np.save(folder / f"image-{index}.npy", studio.photograph(shot))
        answer["background"] = studio.background()
    (folder / "answer.json").write_text(json.dumps(answer))
    sys.stdout.flush()
    os._exit(0)  # bpy may crash while it is taken down


def _leave_with_the_parent(folder):
    sys.stdin.read()
    shutil.rmtree(folder, ignore_errors=True)
    os._exit(0)


class Studio:
    """Blender's scene: bodies, projector and sky of a request."""

    def __init__(self, bpy, folder, request):
        self.bpy = bpy
        self.folder = folder
        self.rig, self.light = request["rig"], request["light"]
        self.raw = request["quality"]["view_transform"] == "raw"
        bpy.ops.wm.read_factory_settings(use_empty=True)
        self.scene = bpy.context.scene
        self.scene.render.engine = "CYCLES"
        self.camera = self._object("camera", bpy.data.cameras.new("camera"))
        self.scene.camera = self.camera
        self.spot = self._object("projector", bpy.data.lights.new("projector", "SPOT"))
        self._fix_settings()
        self._set_quality(request["quality"])
        self._wire_sky()
        with np.load(folder / "scene.npz", allow_pickle=False) as arrays:
            self._wire_projector(arrays["pattern"])
            for index, material in enumerate(request["materials"]):
                vertices, faces = arrays[f"vertices{index}"], arrays[f"faces{index}"]
                self._add_body(f"body{index}", vertices, faces, material)

    def background(self):
        """Return the value of a pixel that sees only the ambient light."""
        ambient = self.light["ambient"]
        if self.raw:
            return ambient
        image = self.bpy.data.images.new("background", 4, 4, float_buffer=True, is_data=False)
        image.pixels.foreach_set(np.tile(np.array([ambient] * 3 + [1.0], np.float32), 16))
        path = self.folder / "background.png"
        image.save_render(str(path), scene=self.scene)
        return self._load(path, 4, 4).item(0)

    def _object(self, name, data):
        thing = self.bpy.data.objects.new(name, data)
        self.scene.collection.objects.link(thing)
        return thing

    def _fix_settings(self):
        """Plain path tracing: every ray counts, none is guessed, dropped or smoothed."""
        scene, cycles, render = self.scene, self.scene.cycles, self.scene.render
        off = "adaptive_sampling", "denoising", "light_tree", "guiding"
        _set(cycles, device="CPU", **{"use_" + name: False for name in off})
        off = "light_sampling_threshold", "sample_clamp_direct", "sample_clamp_indirect"
        _set(cycles, **dict.fromkeys((*off, "blur_glossy", "time_limit"), 0.0))
        _set(cycles, min_light_bounces=0, min_transparent_bounces=0, transparent_max_bounces=16)
        _set(cycles, caustics_reflective=True, caustics_refractive=True)
        _set(cycles, sampling_pattern="TABULATED_SOBOL", film_exposure=1.0)
        off = "compositing", "sequencer", "motion_blur", "file_extension"
        _set(render, **{"use_" + name: False for name in off})
        _set(render, use_persistent_data=True, use_overwrite=True, film_transparent=False)
        _set(render, dither_intensity=0.0, resolution_percentage=100)
        _set(render, pixel_aspect_x=1.0, pixel_aspect_y=1.0)
        _set(render, threads_mode="FIXED", threads=_processors())
        _set(scene.view_settings, look="None", exposure=0.0, gamma=1.0, use_curve_mapping=False)

    def _wire_projector(self, pattern):
        """Look up the pattern along a ray from the projector, as a slide would.

        With n the ray's direction in the light's frame, which looks along −z: column ½ −
        n_x/n_z/(2·tan w), row from below ½ − n_y/n_z/(2·tan h).
        """
        light = self.spot.data
        tangents = self.light["tan_half_width"], self.light["tan_half_height"]
        _set(light, shadow_soft_size=0.0, spot_blend=0.0, use_shadow=True)
        if hasattr(light, "use_soft_falloff"):  # not every version of Blender has it
            light.use_soft_falloff = False
        # The cone holds the corners of the picture; the picture itself ends the light.
        light.spot_size = min(math.pi, 2.02 * math.atan(math.hypot(*tangents)))
        # The setting is the radiant intensity over π; Blender spreads a spot's watts over 4π.
        light.energy = self.light["projector"] * 4 * math.pi**2
        light.cycles.use_multiple_importance_sampling = False
        light.use_nodes = True
        graph = _Graph(light.node_tree)
        split = graph.add(
            "ShaderNodeSeparateXYZ", graph.add("ShaderNodeTexCoord").outputs["Normal"]
        )
        place = graph.add("ShaderNodeCombineXYZ")
        for axis, tangent in enumerate(tangents):
            ratio = graph.math("DIVIDE", split.outputs[axis], split.outputs[2])
            graph.link(graph.math("MULTIPLY_ADD", ratio, -0.5 / tangent, 0.5), place.inputs[axis])
        slide = graph.add("ShaderNodeTexImage", place.outputs[0])
        _set(slide, interpolation="Linear", extension="CLIP", projection="FLAT")
        slide.image = self._picture(pattern)
        emission = graph.add("ShaderNodeEmission", slide.outputs["Color"], 1.0)
        graph.add("ShaderNodeOutputLight", emission.outputs[0])

    def _picture(self, pattern):
        height, width = pattern.shape
        image = self.bpy.data.images.new("pattern", width, height, float_buffer=True, is_data=True)
        image.colorspace_settings.name = "Non-Color"
        image.use_half_precision = False
        texels = np.ones((height, width, 4), np.float32)
        texels[..., :3] = pattern[::-1, :, None]  # Blender's rows go up
        image.pixels.foreach_set(texels.ravel())
        image.update()
        image.pack()
        return image

    def _wire_sky(self):
        """Ambient light everywhere, more of it above the sky's lower edge."""
        world = self.bpy.data.worlds.new("sky")
        self.scene.world = world
        world.use_nodes = True
        graph = _Graph(world.node_tree)
        where = graph.add("ShaderNodeTexCoord").outputs["Generated"]
        height = graph.add("ShaderNodeSeparateXYZ", where).outputs["Z"]
        edge = math.sin(math.radians(self.light["sky_elevation"]))
        above = graph.math("GREATER_THAN", height, edge)
        total = graph.math("MULTIPLY_ADD", above, self.light["sky"], self.light["ambient"])
        white = graph.add("ShaderNodeRGB").outputs[0]
        white.default_value = (1.0, 1.0, 1.0, 1.0)
        background = graph.add("ShaderNodeBackground", white, total)
        graph.add("ShaderNodeOutputWorld", background.outputs[0])
        _set(world.cycles, sampling_method="MANUAL", sample_map_resolution=512)

    def _add_body(self, name, vertices, faces, material):
        mesh = self.bpy.data.meshes.new(name)
        mesh.vertices.add(len(vertices))
        mesh.vertices.foreach_set("co", vertices.astype(np.float32).ravel())
        mesh.loops.add(faces.size)
        mesh.loops.foreach_set("vertex_index", faces.astype(np.int32).ravel())
        mesh.polygons.add(len(faces))
        mesh.polygons.foreach_set("loop_start", np.arange(0, faces.size, 3, dtype=np.int32))
        mesh.update(calc_edges=True)
        mesh.validate()
        mesh.shade_flat()
        mesh.materials.append(self._material(material))
        self._object(name, mesh)

    def _material(self, settings):
        material = self.bpy.data.materials.new("surface")
        material.use_nodes = True
        graph = _Graph(material.node_tree)
        grey = (settings["albedo"],) * 3 + (1.0,)
        model = settings["model"]
        if model in ("diffuse", "mirror"):
            kind = {"diffuse": "Diffuse", "mirror": "Anisotropic"}[model]
            surface = graph.add("ShaderNodeBsdf" + kind)
            _inputs(surface, Color=grey, Roughness=0.0)
        elif model == "principled":
            surface = graph.add("ShaderNodeBsdfPrincipled")
            _inputs(surface, Metallic=settings["metallic"], Roughness=settings["roughness"])
            _inputs(surface, IOR=settings["ior"], **{"Base Color": grey})
        else:
            surface = graph.thin_glass(settings["ior"])
        graph.add("ShaderNodeOutputMaterial", graph.beyond_touch(surface.outputs[0]))
        return material

    def _set_quality(self, quality):
        cycles, bounces = self.scene.cycles, quality["max_bounces"]
        _set(cycles, samples=quality["samples"], max_bounces=bounces)
        for kind in ("diffuse", "glossy", "transmission"):
            setattr(cycles, kind + "_bounces", bounces)
        _set(cycles, pixel_filter_type="BOX", filter_width=1.5)
        self.scene.view_settings.view_transform = "Raw" if self.raw else quality["view_transform"]
        picture = self.scene.render.image_settings
        # Radiance as 32-bit floats, or a display's grey levels in 16 bits.
        if self.raw:
            _set(picture, file_format="OPEN_EXR", color_mode="RGB", color_depth="32")
            picture.exr_codec = "NONE"
        else:
            _set(picture, file_format="PNG", color_mode="RGB", color_depth="16", compression=0)

    def photograph(self, shot):
        """Return the radiance or grey levels of one image."""
        render = self.scene.render
        width, height = self.rig["width"], self.rig["height"]
        x, y, columns, rows = shot["region"]
        _set(render, resolution_x=width, resolution_y=height)
        _set(render, use_border=True, use_crop_to_border=True)
        # Borders are shares of the frame, cut to whole pixels: aim inside each pixel.
        _set(render, border_min_x=(x + 0.25) / width, border_max_x=(x + columns + 0.25) / width)
        low = height - y - rows
        _set(render, border_min_y=(low + 0.25) / height, border_max_y=(low + rows + 0.25) / height)
        lens, focal = self.camera.data, self.rig["focal"]
        _set(lens, sensor_fit="HORIZONTAL", sensor_width=36.0, lens=36.0 * focal / width)
        _set(lens, shift_x=0.0, shift_y=0.0, clip_start=1e-2, clip_end=1e3)
        for thing, pose in ((self.camera, shot["camera"]), (self.spot, shot["projector"])):
            thing.matrix_world = (np.array(pose) @ _TO_BLENDER).T.tolist()
        self.scene.cycles.seed = shot["seed"]
        path = self.folder / "image"
        render.filepath = str(path)
        self.bpy.ops.render.render(write_still=True)
        return self._load(path, columns, rows)

    def _load(self, path, columns, rows):
        """Read a picture that Blender wrote, without any change of its values."""
        image = self.bpy.data.images.load(str(path), check_existing=False)
        image.colorspace_settings.name = "Non-Color"
        width, height = image.size
        texels = np.empty(width * height * image.channels, np.float32)
        image.pixels.foreach_get(texels)
        channels = image.channels
        self.bpy.data.images.remove(image)
        path.unlink()
        if (width, height) != (columns, rows):
            raise RuntimeError(f"Blender rendered {width}×{height} pixels, not {columns}×{rows}")
        grey = texels.reshape(height, width, channels)[::-1, :, : min(channels, 3)].mean(axis=2)
        return np.ascontiguousarray(grey, dtype=np.float32)


class _Graph:
    """A node tree from scratch: nodes are added with what feeds them."""

    def __init__(self, tree):
        tree.nodes.clear()
        self.tree = tree

    def add(self, kind, *feeds, **settings):
        node = self.tree.nodes.new(kind)
        _set(node, **settings)
        for slot, feed in zip(node.inputs, feeds):  # noqa: B905
            self.link(feed, slot)
        return node

    def link(self, feed, slot):
        if isinstance(feed, (int, float)):
            slot.default_value = feed
        else:
            self.tree.links.new(feed, slot)

    def math(self, operation, *feeds):
        return self.add("ShaderNodeMath", *feeds, operation=operation).outputs[0]

    def beyond_touch(self, surface):
        """Let rays that have only just left a surface pass what lies in the same plane.

        Cycles starts a ray in the surface itself and leaves out that one triangle, so that where
        faces of artists' meshes coincide each would shade the other to black.
        """
        path = self.add("ShaderNodeLightPath").outputs
        near = self.math("LESS_THAN", path["Ray Length"], TOUCH)
        start = self.math("MULTIPLY", near, self.math("SUBTRACT", 1.0, path["Is Camera Ray"]))
        clear = self.add("ShaderNodeBsdfTransparent")
        _inputs(clear, Color=(1.0,) * 4)
        return self.add("ShaderNodeMixShader", start, surface, clear.outputs[0]).outputs[0]

    def thin_glass(self, ior):
        """A pane: reflects R = 2F/(1 + F) of the light, lets the rest pass unbent.

        F is Fresnel's share of one face; the sum over the echoes inside the pane gives R.
        """
        back = self.add("ShaderNodeNewGeometry").outputs["Backfacing"]
        index = self.math("MULTIPLY_ADD", back, 1 / ior - ior, ior)  # faces of either winding
        fresnel = self.add("ShaderNodeFresnel", index).outputs[0]
        twice = self.math("MULTIPLY", fresnel, 2.0)
        share = self.math("DIVIDE", twice, self.math("ADD", fresnel, 1.0))
        clear = self.add("ShaderNodeBsdfTransparent")
        shine = self.add("ShaderNodeBsdfAnisotropic")
        _inputs(clear, Color=(1.0,) * 4)
        _inputs(shine, Color=(1.0,) * 4, Roughness=0.0)
        return self.add("ShaderNodeMixShader", share, clear.outputs[0], shine.outputs[0])


def _inputs(node, **values):
    for name, value in values.items():
        node.inputs[name].default_value = value


def _set(thing, **values):
    for name, value in values.items():
        setattr(thing, name, value)


def _processors():
    try:
        return max(1, min(1024, len(os.sched_getaffinity(0))))
    except AttributeError:
        return max(1, min(1024, os.cpu_count() or 1))


if __name__ == "__main__":
    main()
