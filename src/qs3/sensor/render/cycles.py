"""Blender's Cycles, the paper's renderer, in its own process.

Blender's module `bpy` (GPL-3, NumPy below 2, one version of Python) never enters this process: for
each object a worker (``_cycles_worker.py``) starts, which takes 1.3 s, reads a request and arrays
from a private folder, and leaves arrays and an answer there.
"""

import contextlib
import functools
import importlib.util
import json
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from jaxtyping import Float32

from qs3.errors import InputError, MissingExtraError, QS3Error
from qs3.sensor.checks import Bounds, Positive, check
from qs3.sensor.render import MOST_SAMPLES, Scene, StereoPair, view_regions
from qs3.sensor.rig import Pose, Region, StereoRig

_QUALITY = ("samples", "max_bounces", "view_transform")
_WORKER = Path(__file__).with_name("_cycles_worker.py")
_START_SECONDS = 300.0


class RenderError(QS3Error, RuntimeError):
    """A renderer's own process failed; the object it was given fails, the next one does not."""


def interpreter() -> tuple[str, ...] | None:
    """The command that starts the worker, or None if there is no Blender.

    Looked up in this order: ``QS3_BLENDER``, a Blender of version 4.2 or newer;
    ``QS3_CYCLES_PYTHON``, a Python with ``bpy``; this Python, if it has ``bpy``; the environment
    that ``make cycles`` puts beside this one (``.venv-cycles`` beside ``.venv``).
    """
    blender = _named("QS3_BLENDER")
    if blender is not None:
        # --python-exit-code: a fault while the worker's file is read ends Blender too.
        flags = ("--background", "--factory-startup", "--python-exit-code", "1")
        return (blender, *flags, "--python", str(_WORKER), "--")
    python = _named("QS3_CYCLES_PYTHON")
    if python is None and importlib.util.find_spec("bpy") is not None:
        python = sys.executable
    if python is None:
        beside = Path(f"{sys.prefix}-cycles")
        places = beside / "bin" / "python", beside / "Scripts" / "python.exe"
        python = next((str(place) for place in places if place.is_file()), None)
    return None if python is None else (python, str(_WORKER))


def _named(variable: str) -> str | None:
    value = os.environ.get(variable)
    if not value:
        return None
    if not Path(value).is_file():
        raise InputError(f"{variable}: {value} is not a file; name a program or unset the variable")
    return value


@dataclass(frozen=True)
class CyclesRenderer:
    """Photographs scenes with Blender's Cycles on the CPU: path tracing, one bounce of light."""

    samples: Annotated[int, Bounds(1, MOST_SAMPLES)] = 128
    """Rays a pixel; every pixel gets them all (no adaptive sampling, no denoising)."""
    max_bounces: Annotated[int, Bounds(high=128)] = 1
    """Bounces of light: 0 is direct light alone, 1 is Mitsuba's ``max_depth`` of 3."""
    view_transform: Literal["raw", "Standard", "Filmic", "AgX"] = "raw"
    """``raw`` returns linear radiance; the others the grey levels in 0…1 that Blender would show.
    The released scanner has Filmic."""
    full_frame: bool = False
    """Render whole frames, not the object's region."""
    timeout: Positive = 900.0
    """Seconds an image after which the worker counts as hung."""

    def __post_init__(self) -> None:
        check(self, "renderer")

    @property
    def description(self) -> dict[str, str]:
        """Name, version and variant, for records; an error if there is no Blender that starts."""
        versions = _versions(_command())
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
        """Render ``scene`` once from each pose: `qs3.sensor.render.Renderer`.

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
            "quality": {name: getattr(self, name) for name in _QUALITY},
            "shots": shots,
        }
        arrays: dict[str, Any] = {"pattern": np.asarray(scene.pattern, np.float32)}
        for index, body in enumerate(scene.bodies):
            arrays[f"vertices{index}"] = np.asarray(body.mesh.vertices, np.float32)
            arrays[f"faces{index}"] = np.asarray(body.mesh.faces, np.int32)
        seconds = _START_SECONDS + self.timeout * len(shots)
        answer, images = _ask(_command(), request, seconds, arrays)
        rendered, display = iter(images), self.view_transform != "raw"
        background = float(answer["background"])
        pairs = []
        for pose, parts in zip(poses, views, strict=True):
            left, right = (
                np.zeros(part.shape, np.float32) if part.empty else next(rendered) for part in parts
            )
            pairs.append(StereoPair(left, right, *parts, background, pose, display))
        return pairs


def _ask(
    command: tuple[str, ...], request: Mapping[str, Any], seconds: float, arrays: Mapping[str, Any]
) -> tuple[dict[str, Any], list[Float32[np.ndarray, "_ _"]]]:
    """Have a worker answer a request; its whole process group ends before this returns."""
    with tempfile.TemporaryDirectory(prefix="qs3-cycles-") as name:
        folder = Path(name)
        np.savez(folder / "scene.npz", **arrays)
        (folder / "request.json").write_text(json.dumps(request))
        with (folder / "worker.log").open("wb") as log:
            try:
                # Its own session: Ctrl-C in the terminal is the parent's to act on. It watches its
                # standard input, which closes with this process.
                worker = subprocess.Popen(
                    [*command, name],
                    stdin=subprocess.PIPE,
                    stdout=log,
                    stderr=log,
                    start_new_session=True,
                )
            except OSError as error:
                raise RenderError(f"{command[0]} does not start: {error.strerror}") from error
        with worker:
            try:
                code = worker.wait(seconds)
                fault = f"ended with exit code {code}" if code else ""
                if code < 0:
                    fault = f"was killed by signal {signal.Signals(-code).name}"
            except subprocess.TimeoutExpired:
                fault = f"kept silent for {seconds:g} s"
            finally:
                if os.name == "posix":
                    with contextlib.suppress(ProcessLookupError, PermissionError):
                        os.killpg(worker.pid, signal.SIGKILL)
                else:
                    worker.kill()
        answer = folder / "answer.json"
        if fault or not answer.is_file():
            text = (folder / "worker.log").read_text(errors="replace")
            lines = [line.strip() for line in text.splitlines() if line.strip()]
            end = f"; its log ends: {' | '.join(lines[-4:])}" if lines else ""
            raise RenderError(f"the renderer's process {fault or 'left no answer'}{end}")
        count = len(request.get("shots", ()))
        images = [np.load(folder / f"image-{index}.npy") for index in range(count)]
        return json.loads(answer.read_text()), images


def find_cycles() -> dict[str, str]:
    """Return the ``command`` of Cycles and its versions; empty without Blender."""
    command = interpreter()
    if command is None:
        return {}
    return {"command": command[0], **_versions(command)}


def _command() -> tuple[str, ...]:
    command = interpreter()
    if command is None:
        error = MissingExtraError("bpy (Blender's Cycles)", "cycles")
        error.msg = (
            "Cycles is not here: in a checkout, `make cycles` brings it (the extra 'cycles'), or "
            "set QS3_BLENDER to a Blender 4.2 or newer, or QS3_CYCLES_PYTHON to a Python with bpy"
        )
        raise error
    return command


@functools.cache
def _versions(command: tuple[str, ...]) -> dict[str, str]:
    return _ask(command, {}, _START_SECONDS, {})[0]
