"""Cycles renderer in its own process; started by ``cycles.py``, never imported.

The only file with ``bpy``; it uses the standard library, NumPy and ``bpy`` alone. It renders the
request in its folder, writes arrays and an answer there, and ends; at once if the standard input
does.
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

    answer = {"blender": bpy.app.version_string, "python": sys.version.split()[0]}
    request = json.loads((folder / "request.json").read_text())
    if request:
        studio = Studio(bpy, folder, request)
        for index, shot in enumerate(request["shots"]):
            np.save(folder / f"image-{index}.npy", studio.photograph(shot))
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
        bpy.ops.wm.read_factory_settings(use_empty=True)
        self.scene = bpy.context.scene
        self.scene.render.engine = "CYCLES"
        self.camera = self._object("camera", bpy.data.cameras.new("camera"))
        self.scene.camera = self.camera
        self.spot = self._object("projector", bpy.data.lights.new("projector", "SPOT"))
        self._set_quality(request["samples"], request["max_bounces"])
        self._wire_sky()
        with np.load(folder / "scene.npz", allow_pickle=False) as arrays:
            self._wire_projector(arrays["pattern"])
            for index, material in enumerate(request["materials"]):
                vertices, faces = arrays[f"vertices{index}"], arrays[f"faces{index}"]
                self._add_body(f"body{index}", vertices, faces, material)

    def _object(self, name, data):
        thing = self.bpy.data.objects.new(name, data)
        self.scene.collection.objects.link(thing)
        return thing

    def _set_quality(self, samples, bounces):
        """Plain path tracing: every ray counts, none is guessed, dropped or smoothed."""
        cycles, render = self.scene.cycles, self.scene.render
        _set(cycles, device="CPU", samples=samples)
        _set(cycles, use_adaptive_sampling=False, use_denoising=False, use_light_tree=False)
        _set(cycles, light_sampling_threshold=0.0, sample_clamp_indirect=0.0, blur_glossy=0.0)
        _set(cycles, pixel_filter_type="BOX", max_bounces=bounces, diffuse_bounces=bounces)
        _set(cycles, glossy_bounces=bounces, transmission_bounces=bounces)
        _set(cycles, transparent_max_bounces=16)
        _set(render, use_persistent_data=True, use_file_extension=False, dither_intensity=0.0)
        _set(render, threads_mode="FIXED", threads=_processors())
        _set(render, resolution_x=self.rig["width"], resolution_y=self.rig["height"])
        _set(render, use_border=True, use_crop_to_border=True)
        self.scene.view_settings.view_transform = "Raw"
        _set(render.image_settings, file_format="OPEN_EXR", color_mode="RGB", color_depth="32")
        render.image_settings.exr_codec = "NONE"
        lens = 36.0 * self.rig["focal"] / self.rig["width"]
        _set(self.camera.data, sensor_fit="HORIZONTAL", lens=lens, clip_start=1e-2)

    def _wire_projector(self, pattern):
        """Look up the pattern along a ray from the projector, as a slide would.

        With n the ray's direction in the light's frame, which looks along −z: column ½ −
        n_x/n_z/(2·tan w), row from below ½ − n_y/n_z/(2·tan h).
        """
        light = self.spot.data
        tangents = self.light["tan_half_width"], self.light["tan_half_height"]
        _set(light, spot_blend=0.0, use_soft_falloff=False)
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

    def photograph(self, shot):
        """Return the radiance of one image."""
        render, (x, y, columns, rows) = self.scene.render, shot["region"]
        width, height = self.rig["width"], self.rig["height"]
        # Borders are shares of the frame, cut to whole pixels: aim inside each pixel.
        _set(render, border_min_x=(x + 0.25) / width, border_max_x=(x + columns + 0.25) / width)
        low = height - y - rows
        _set(render, border_min_y=(low + 0.25) / height, border_max_y=(low + rows + 0.25) / height)
        for thing, pose in ((self.camera, shot["camera"]), (self.spot, shot["projector"])):
            thing.matrix_world = (np.array(pose) @ _TO_BLENDER).T.tolist()
        self.scene.cycles.seed = shot["seed"]
        path = self.folder / "image"
        render.filepath = str(path)
        self.bpy.ops.render.render(write_still=True)
        image = self.bpy.data.images.load(str(path), check_existing=False)
        image.colorspace_settings.name = "Non-Color"
        texels = np.empty(rows * columns * image.channels, np.float32)
        image.pixels.foreach_get(texels)  # fails on an image of another size
        grey = texels.reshape(rows, columns, -1)[::-1, :, :3].mean(axis=2)
        self.bpy.data.images.remove(image)
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
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


if __name__ == "__main__":
    main()
