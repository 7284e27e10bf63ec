"""Blender's Cycles, the paper's renderer, in its own process.

Blender's module `bpy` (GPL-3, NumPy below 2, one version of Python) never enters this process: for
each object a worker (``_cycles_worker.py``) starts, which takes 1.3 s, reads a request and arrays
from a private folder, and leaves arrays and an answer there.
"""

import functools
import importlib.util
import json
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from jaxtyping import Float32

from qs3.checks import Bounds, check
from qs3.errors import MissingExtraError, QS3Error
from qs3.sensor.light import MOST_SAMPLES, Scene, StereoPair, view_regions
from qs3.sensor.rig import Pose, Region, StereoRig

_WORKER = Path(__file__).with_name("_cycles_worker.py")
_START_SECONDS, _SECONDS = 300.0, 900.0
"""Time for the start of the worker and for each image, after which it counts as hung."""


class RenderError(QS3Error, RuntimeError):
    """A renderer's own process failed; the object it was given fails, the next one does not."""


def interpreter() -> str | None:
    """Return this Python if it has ``bpy``, else that of `make cycles`, else None.

    `make cycles` puts an environment ``.venv-cycles`` beside this one, ``.venv``.
    """
    if importlib.util.find_spec("bpy") is not None:
        return sys.executable
    beside = Path(f"{sys.prefix}-cycles")
    places = beside / "bin" / "python", beside / "Scripts" / "python.exe"
    return next((str(place) for place in places if place.is_file()), None)


@dataclass(frozen=True)
class CyclesRenderer:
    """Photographs scenes with Blender's Cycles on the CPU: path tracing, one bounce of light."""

    samples: Annotated[int, Bounds(1, MOST_SAMPLES)] = 128
    """Rays per pixel; every pixel gets them all (no adaptive sampling, no denoising)."""
    max_bounces: Annotated[int, Bounds(high=128)] = 1
    """Bounces of light: 0 is direct light alone, 1 is Mitsuba's ``max_depth`` of 3."""
    full_frame: bool = False
    """Render whole frames, not the object's region."""

    def __post_init__(self) -> None:
        check(self, "renderer")

    @property
    def description(self) -> dict[str, str]:
        """Name, version and variant, for records; an error if there is no Blender that starts."""
        versions = _versions(_python())
        names = {"name": "cycles", "version": versions["blender"], "variant": "cpu"}
        return names | {"python": versions["python"]}

    def render(
        self,
        scene: Scene,
        rig: StereoRig,
        poses: Sequence[Pose],
        seeds: Sequence[int],
        regions: Sequence[Region] | None = None,
    ) -> list[StereoPair]:
        """Render ``scene`` once from each pose: `qs3.sensor.light.Renderer`.

        Raises:
            RenderError: if the worker died, hung or reported a fault; the next call starts another.
        """
        views = view_regions(scene, rig, poses, seeds, regions, self.full_frame)
        shots = [
            {
                "camera": camera.camera_to_world.tolist(),
                "projector": rig.projector(pose).camera_to_world.tolist(),
                "region": [region.x, region.y, region.width, region.height],
                # Two streams that never meet: the left camera's seeds are even.
                "seed": (2 * seed + side) % 2**31,
            }
            for pose, seed, parts in zip(poses, seeds, views, strict=True)
            for side, camera, region in zip((0, 1), (pose, rig.right(pose)), parts, strict=True)
            if not region.empty
        ]
        light = {name: float(value) for name, value in vars(scene.light).items()}
        light |= {name: getattr(scene, name) for name in ("tan_half_width", "tan_half_height")}
        request = {
            "materials": [vars(body.material) for body in scene.bodies],
            "light": light,
            "rig": {"width": rig.width, "height": rig.height, "focal": rig.focal},
            "samples": self.samples,
            "max_bounces": self.max_bounces,
            "shots": shots,
        }
        arrays: dict[str, Any] = {"pattern": np.asarray(scene.pattern, np.float32)}
        for index, body in enumerate(scene.bodies):
            arrays[f"vertices{index}"] = np.asarray(body.mesh.vertices, np.float32)
            arrays[f"faces{index}"] = np.asarray(body.mesh.faces, np.int32)
        rendered = iter(_run_worker(_python(), request, arrays)[1])
        pairs = []
        for pose, parts in zip(poses, views, strict=True):
            left, right = (
                np.zeros(part.shape, np.float32) if part.empty else next(rendered) for part in parts
            )
            pairs.append(StereoPair(left, right, *parts, scene.light.ambient, pose))
        return pairs


def _run_worker(
    python: str, request: Mapping[str, Any], arrays: Mapping[str, Any]
) -> tuple[dict[str, Any], list[Float32[np.ndarray, "_ _"]]]:
    """Have a worker answer a request; it ends before this returns."""
    count = len(request.get("shots", ()))
    seconds, fault = _START_SECONDS + _SECONDS * count, ""
    with tempfile.TemporaryDirectory(prefix="qs3-cycles-") as name:
        folder = Path(name)
        np.savez(folder / "scene.npz", **arrays)
        (folder / "request.json").write_text(json.dumps(request))
        # Its own session: Ctrl-C in the terminal is the parent's to act on. It watches its
        # standard input, which closes with this process.
        with (
            (folder / "worker.log").open("wb") as log,
            subprocess.Popen(
                [python, str(_WORKER), name],
                stdin=subprocess.PIPE,
                stdout=log,
                stderr=log,
                start_new_session=True,
            ) as worker,
        ):
            try:
                if code := worker.wait(seconds):
                    fault = f"ended with exit code {code}"
            except subprocess.TimeoutExpired:
                fault = f"kept silent for {seconds:g} s"
            finally:
                worker.kill()
        answer = folder / "answer.json"
        if fault or not answer.is_file():
            lines = (folder / "worker.log").read_text(errors="replace").split("\n")
            end = " | ".join(line.strip() for line in lines[-5:] if line.strip())
            raise RenderError(
                f"the renderer's process {fault or 'left no answer'}; its log ends: {end}"
            )
        images = [np.load(folder / f"image-{index}.npy") for index in range(count)]
        return json.loads(answer.read_text()), images


def find_cycles() -> dict[str, str]:
    """Return the versions of Blender and its Python; empty without Blender."""
    python = interpreter()
    return {} if python is None else _versions(python)


def _python() -> str:
    if (python := interpreter()) is not None:
        return python
    error = MissingExtraError("bpy (Blender's Cycles)", "cycles")
    error.msg = "Cycles is not here: in a checkout, `make cycles` brings it (the extra 'cycles')"
    raise error


@functools.cache
def _versions(python: str) -> dict[str, str]:
    return _run_worker(python, {}, {})[0]
