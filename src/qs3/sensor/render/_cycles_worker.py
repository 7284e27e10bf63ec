"""Cycles renderer in its own process; started by ``cycles.py``, never imported.

The only file with ``bpy``. It runs in Blender's Python or any Python with ``bpy``, so it uses only
the standard library, NumPy and ``bpy``. Requests are JSON lines on standard input, answers JSON
lines behind a mark on standard output; arrays are files in a private folder. The end of the
standard input ends the process.
"""

import json
import math
import os
import queue
import shutil
import sys
import threading
import traceback
import warnings

# The folder of this file holds modules whose names must not hide installed packages.
_HERE = os.path.dirname(os.path.abspath(__file__))  # noqa: PTH100, PTH120
sys.path[:] = [folder for folder in sys.path if os.path.abspath(folder or ".") != _HERE]  # noqa: PTH100

import numpy as np  # noqa: E402

MARK = "@qs3 "
TOUCH = 1.5e-4  # Mitsuba's rays start so far from an object of size 1
# OpenCV's camera (x right, y down, z forward) in terms of Blender's (x right, y up, z backward).
_TO_BLENDER = np.diag([1.0, -1.0, -1.0, 1.0])


def main():
    """Answer requests until the standard input ends."""
    answers = os.fdopen(os.dup(1), "w", encoding="utf-8")
    os.dup2(2, 1)  # Blender's output goes to the log
    folder = sys.argv[-1]
    requests = queue.Queue()
    threading.Thread(target=_read, args=(requests, folder), daemon=True).start()

    def answer(**message):
        answers.write(MARK + json.dumps(message) + "\n")
        answers.flush()

    try:
        warnings.simplefilter("ignore", DeprecationWarning)
        studio = Studio(folder)
        answer(
            event="ready", blender=studio.version, python=sys.version.split()[0], pid=os.getpid()
        )
        while True:
            request = requests.get()
            for index, shot in enumerate(studio.photograph(request)):
                answer(event="image", index=index, file=shot)
            answer(event="done", background=studio.background(request))
    except BaseException as error:
        traceback.print_exc()
        answer(event="error", reason=f"{type(error).__name__}: {error}")
        os._exit(1)


def _read(requests, folder):
    """Hand requests over; leave at once when the parent closes the pipe or dies."""
    for line in sys.stdin:
        requests.put(json.loads(line))
    shutil.rmtree(folder, ignore_errors=True)
    os._exit(0)


class Studio:
    """Blender's scene: camera, projector and sky stay, bodies change."""

    def __init__(self, folder):
        import bpy  # pyright: ignore[reportMissingImports]

        self.bpy = bpy
        self.folder = folder
        self.version = bpy.app.version_string
        if tuple(int(part) for part in self.version.split()[0].split(".")[:2]) < (4, 2):
            raise RuntimeError(f"Blender {self.version} is too old: 4.2 or newer is needed")
        bpy.ops.wm.read_factory_settings(use_empty=True)
        self.scene = bpy.context.scene
        self.scene.render.engine = "CYCLES"
        self.pattern = self.quality = None
        self.bodies = []
        self.camera = self._object("camera", bpy.data.cameras.new("camera"))
        self.scene.camera = self.camera
        self.spot = self._object("projector", bpy.data.lights.new("projector", "SPOT"))
        self._wire_projector()
        self._wire_sky()
        self._fix_settings()

    def photograph(self, request):
        """Build the scene of a request and yield the file of each image as it is done."""
        with np.load(request["scene"], allow_pickle=False) as arrays:
            self._set_projector(arrays["pattern"], request["light"])
            self._set_sky(request["light"])
            self._set_bodies(arrays, request["materials"])
        self._set_quality(request["quality"])
        for shot in request["shots"]:
            yield self._photograph(shot, request)

    def background(self, request):
        """Return the value of a pixel that sees only the ambient light."""
        ambient = request["light"]["ambient"]
        if request["quality"]["view_transform"] == "raw":
            return ambient
        image = self.bpy.data.images.new("background", 4, 4, float_buffer=True, is_data=False)
        image.pixels.foreach_set(np.tile(np.array([ambient] * 3 + [1.0], np.float32), 16))
        path = os.path.join(self.folder, "background.png")  # noqa: PTH118
        image.save_render(path, scene=self.scene)
        self.bpy.data.images.remove(image)
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

    def _wire_projector(self):
        """Look up the pattern along a ray from the projector, as a slide would.

        With n the ray's direction in the light's frame, which looks along −z: column ½ −
        n_x/n_z/(2·tan w), row from below ½ − n_y/n_z/(2·tan h).
        """
        light = self.spot.data
        _set(light, shadow_soft_size=0.0, spot_blend=0.0, use_shadow=True)
        if hasattr(light, "use_soft_falloff"):  # not every version of Blender has it
            light.use_soft_falloff = False
        light.cycles.use_multiple_importance_sampling = False
        light.use_nodes = True
        graph = _Graph(light.node_tree)
        split = graph.add(
            "ShaderNodeSeparateXYZ", graph.add("ShaderNodeTexCoord").outputs["Normal"]
        )
        place = graph.add("ShaderNodeCombineXYZ")
        self.slopes = []
        for axis in (0, 1):
            ratio = graph.math("DIVIDE", split.outputs[axis], split.outputs[2])
            scaled = graph.math("MULTIPLY_ADD", ratio, 1.0, 0.5)
            self.slopes.append(graph.nodes[-1].inputs[1])
            graph.link(scaled, place.inputs[axis])
        self.slide = graph.add("ShaderNodeTexImage", place.outputs[0])
        _set(self.slide, interpolation="Linear", extension="CLIP", projection="FLAT")
        emission = graph.add("ShaderNodeEmission", self.slide.outputs["Color"], 1.0)
        graph.add("ShaderNodeOutputLight", emission.outputs[0])

    def _wire_sky(self):
        """Ambient light everywhere, more of it above the sky's lower edge."""
        world = self.bpy.data.worlds.new("sky")
        self.scene.world = world
        world.use_nodes = True
        graph = _Graph(world.node_tree)
        where = graph.add("ShaderNodeTexCoord").outputs["Generated"]
        height = graph.add("ShaderNodeSeparateXYZ", where).outputs["Z"]
        above = graph.math("GREATER_THAN", height, 0.0)
        self.sky_edge = graph.nodes[-1].inputs[1]
        total = graph.math("MULTIPLY_ADD", above, 1.0, 0.0)
        self.sky_level = graph.nodes[-1].inputs[1]
        self.ambient_level = graph.nodes[-1].inputs[2]
        white = graph.add("ShaderNodeRGB").outputs[0]
        white.default_value = (1.0, 1.0, 1.0, 1.0)
        background = graph.add("ShaderNodeBackground", white, total)
        graph.add("ShaderNodeOutputWorld", background.outputs[0])
        _set(world.cycles, sampling_method="MANUAL", sample_map_resolution=512)

    def _set_projector(self, pattern, light):
        tangents = light["tan_half_width"], light["tan_half_height"]
        for slope, tangent in zip(self.slopes, tangents, strict=True):
            slope.default_value = -0.5 / tangent
        # The cone holds the corners of the picture; the picture itself ends the light.
        self.spot.data.spot_size = min(math.pi, 2.02 * math.atan(math.hypot(*tangents)))
        # The setting is the radiant intensity over π; Blender spreads a spot's watts over 4π.
        self.spot.data.energy = light["projector"] * 4 * math.pi**2
        if self.pattern is not None and np.array_equal(self.pattern, pattern):
            return
        height, width = pattern.shape
        image = self.bpy.data.images.new("pattern", width, height, float_buffer=True, is_data=True)
        image.colorspace_settings.name = "Non-Color"
        image.use_half_precision = False
        texels = np.ones((height, width, 4), np.float32)
        texels[..., :3] = pattern[::-1, :, None]  # Blender's rows go up
        image.pixels.foreach_set(texels.ravel())
        image.update()
        image.pack()
        before, self.slide.image = self.slide.image, image
        if before is not None:
            self.bpy.data.images.remove(before)
        self.pattern = pattern

    def _set_sky(self, light):
        self.sky_edge.default_value = math.sin(math.radians(light["sky_elevation"]))
        self.sky_level.default_value = light["sky"]
        self.ambient_level.default_value = light["ambient"]

    def _set_bodies(self, arrays, materials):
        data = self.bpy.data
        for body in self.bodies:
            mesh = body.data
            surface = mesh.materials[0]
            data.objects.remove(body)
            data.meshes.remove(mesh)
            data.materials.remove(surface)
        self.bodies = []
        for index, material in enumerate(materials):
            vertices, faces = arrays[f"vertices{index}"], arrays[f"faces{index}"]
            mesh = data.meshes.new(f"body{index}")
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
            self.bodies.append(self._object(f"body{index}", mesh))

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
        if quality != self.quality:
            # Cycles keeps its table of random numbers once it has grown: let go of it, else the
            # bits would depend on what was rendered before.
            self.scene.render.use_persistent_data = False
            self.scene.render.use_persistent_data = True
            self.quality = quality
        cycles, bounces = self.scene.cycles, quality["max_bounces"]
        _set(cycles, samples=quality["samples"], max_bounces=bounces)
        for kind in ("diffuse", "glossy", "transmission"):
            setattr(cycles, kind + "_bounces", bounces)
        box = quality["pixel_filter"] == "box"
        _set(cycles, pixel_filter_type="BOX" if box else "BLACKMAN_HARRIS", filter_width=1.5)
        raw = quality["view_transform"] == "raw"
        self.scene.view_settings.view_transform = "Raw" if raw else quality["view_transform"]
        picture = self.scene.render.image_settings
        # Radiance as 32-bit floats, or a display's grey levels in 16 bits.
        if raw:
            _set(picture, file_format="OPEN_EXR", color_mode="RGB", color_depth="32")
            picture.exr_codec = "NONE"
        else:
            _set(picture, file_format="PNG", color_mode="RGB", color_depth="16", compression=0)

    def _photograph(self, shot, request):
        rig, render = request["rig"], self.scene.render
        width, height = rig["width"], rig["height"]
        x, y, columns, rows = shot["region"]
        _set(render, resolution_x=width, resolution_y=height)
        _set(render, use_border=True, use_crop_to_border=True)
        # Borders are shares of the frame, cut to whole pixels: aim inside each pixel.
        _set(render, border_min_x=(x + 0.25) / width, border_max_x=(x + columns + 0.25) / width)
        low = height - y - rows
        _set(render, border_min_y=(low + 0.25) / height, border_max_y=(low + rows + 0.25) / height)
        lens = self.camera.data
        _set(lens, sensor_fit="HORIZONTAL", sensor_width=36.0, lens=36.0 * rig["focal"] / width)
        _set(lens, shift_x=0.0, shift_y=0.0, clip_start=1e-2, clip_end=1e3)
        for thing, pose in ((self.camera, shot["camera"]), (self.spot, shot["projector"])):
            thing.matrix_world = (np.array(pose) @ _TO_BLENDER).T.tolist()
        self.scene.cycles.seed = shot["seed"]
        path = os.path.join(self.folder, "image")  # noqa: PTH118
        render.filepath = path
        self.bpy.ops.render.render(write_still=True)
        image = self._load(path, columns, rows)
        np.save(shot["file"], image)
        return shot["file"]

    def _load(self, path, columns, rows):
        """Read a picture that Blender wrote, without any change of its values."""
        image = self.bpy.data.images.load(path, check_existing=False)
        image.colorspace_settings.name = "Non-Color"
        width, height = image.size
        texels = np.empty(width * height * image.channels, np.float32)
        image.pixels.foreach_get(texels)
        channels = image.channels
        self.bpy.data.images.remove(image)
        os.unlink(path)  # noqa: PTH108
        if (width, height) != (columns, rows):
            raise RuntimeError(f"Blender rendered {width}×{height} pixels, not {columns}×{rows}")
        grey = texels.reshape(height, width, channels)[::-1, :, : min(channels, 3)].mean(axis=2)
        return np.ascontiguousarray(grey, dtype=np.float32)


class _Graph:
    """A node tree from scratch: nodes are added with what feeds them."""

    def __init__(self, tree):
        tree.nodes.clear()
        self.tree = tree
        self.nodes = []

    def add(self, kind, *feeds, **settings):
        node = self.tree.nodes.new(kind)
        _set(node, **settings)
        self.nodes.append(node)
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
