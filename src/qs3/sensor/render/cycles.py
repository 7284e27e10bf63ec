"""The paper's renderer: Blender's Cycles, in a process of its own.

Scene, rig, poses and pattern are the very objects that Mitsuba is handed. Blender's Python module
`bpy` (GPL-3, NumPy below 2, one version of Python) never enters this process: a worker renders,
is told what to do in lines of JSON, and hands arrays back as files.
"""

import functools
import importlib.util
import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import numpy as np
from jaxtyping import Float32

from qs3.errors import InputError, MissingExtraError
from qs3.sensor.render._worker_process import RenderError as RenderError
from qs3.sensor.render._worker_process import Worker, borrow, idle_process
from qs3.sensor.render.scene import Scene, StereoPair, photographed_region, refuse_sky
from qs3.sensor.rig import Pose, Region, StereoRig

_WORKER = Path(__file__).with_name("_cycles_worker.py")


def interpreter() -> tuple[str, ...] | None:
    """The command that starts the worker, or None where there is no Blender.

    Looked up in this order: ``QS3_BLENDER``, a Blender of version 4.2 or newer;
    ``QS3_CYCLES_PYTHON``, a Python with ``bpy``; this Python, if it has ``bpy``; the environment
    that ``make cycles`` puts beside this one (``.venv-cycles`` beside ``.venv``).

    Raises:
        InputError: where one of the variables names no file.
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
        for place in (beside / "bin" / "python", beside / "Scripts" / "python.exe"):
            if place.is_file():
                python = str(place)
                break
    return None if python is None else (python, str(_WORKER))


def _named(variable: str) -> str | None:
    value = os.environ.get(variable)
    if not value:
        return None
    if not Path(value).is_file():
        raise InputError(f"{variable}: {value} is no file; name a program or unset the variable")
    return value


@dataclass(frozen=True)
class CyclesRenderer:
    """Photographs scenes with Blender's Cycles on the CPU: path tracing, one bounce of light."""

    samples: int = 128
    """Rays a pixel; every pixel gets them all (no adaptive sampling, no denoising)."""
    max_bounces: int = 1
    """Bounces of light: 0 is direct light alone, 1 is Mitsuba's ``max_depth`` of 3."""
    pixel_filter: Literal["box", "blackman-harris"] = "box"
    """``box``: a pixel sees its own square, as with Mitsuba. ``blackman-harris``: Blender's own
    filter, 1.5 pixels wide, which blurs the dots as a lens does."""
    view_transform: Literal["raw", "Standard", "Filmic", "AgX"] = "raw"
    """``raw`` hands back linear radiance. The others hand back the grey levels in 0…1 that
    Blender would show; the released scanner has Filmic."""
    full_frame: bool = False
    """Render whole frames in place of the object's region."""
    objects_per_worker: int = 50
    """Objects after which the worker is replaced, so that its memory stays bounded; 0 is never."""
    timeout: float = 900.0
    """Seconds that one image may take before its worker counts as hung."""

    def __post_init__(self) -> None:
        choices = {
            "pixel_filter": ("box", "blackman-harris"),
            "view_transform": ("raw", "Standard", "Filmic", "AgX"),
        }
        for name, allowed in choices.items():
            if getattr(self, name) not in allowed:
                raise InputError(
                    f"renderer: no {name} {getattr(self, name)!r}; choose {', '.join(allowed)}"
                )
        for name, lowest in {"samples": 1, "max_bounces": 0, "objects_per_worker": 0}.items():
            if getattr(self, name) < lowest:
                raise InputError(f"renderer: {name} {getattr(self, name)} is below {lowest}")
        if not self.timeout > 0:
            raise InputError(f"renderer: timeout {self.timeout} must be above 0 seconds")

    @property
    def description(self) -> dict[str, str]:
        """Name, version and variant, for records.

        Raises:
            MissingExtraError: where there is no Blender.
            RenderError: where it does not start.
        """
        versions = _versions(_command())
        return {"name": "cycles", "version": versions["blender"], "variant": "cpu"} | {
            "python": versions["python"]
        }

    def render(
        self,
        scene: Scene,
        rig: StereoRig,
        poses: Sequence[Pose],
        seeds: Sequence[int],
        regions: Sequence[Region] | None = None,
    ) -> list[StereoPair]:
        """Photograph ``scene`` once from each pose; equal seeds give equal bits.

        Raises:
            InputError: where a camera sees the sky past a lone object.
            MissingExtraError: where there is no Blender.
            RenderError: where the worker died, hung or reported a fault; the next call starts a
                fresh one.
            ValueError: where there is not one seed (and region, if given) for each pose.
        """
        if len(poses) != len(seeds) or (regions is not None and len(regions) != len(poses)):
            raise ValueError(f"{len(poses)} poses and {len(seeds)} seeds, or too few regions")
        shots, layout = [], []
        for index, (pose, seed) in enumerate(zip(poses, seeds, strict=True)):
            sides = []
            given = None if regions is None else regions[index]
            for side, camera in enumerate((pose, rig.right(pose))):
                region = self._region(scene, rig, camera, side, given)
                sides.append(region)
                if not region.empty:
                    # Two streams that never meet: the left camera's seeds are even.
                    shots.append(_shot(rig, pose, camera, region, (2 * seed + side) % 2**31))
            if sides[0] != rig.full_frame and scene.alone:
                refuse_sky(rig, pose, scene.light)
            layout.append((pose, *sides))
        with borrow(_command(), self.objects_per_worker) as worker:
            images, background = self._ask(worker, scene, rig, shots)
        done = iter(images)
        pairs = []
        display = self.view_transform != "raw"
        for pose, *sides in layout:
            left, right = (_empty(region) if region.empty else next(done) for region in sides)
            pairs.append(StereoPair(left, right, sides[0], sides[1], background, pose, display))
        return pairs

    def _region(
        self, scene: Scene, rig: StereoRig, camera: Pose, side: int, given: Region | None
    ) -> Region:
        if side == 1 and rig.second == "pattern":
            return Region(0, 0, 0, 0)
        if self.full_frame:
            return rig.full_frame
        return photographed_region(scene, rig, camera) if given is None else given

    def _ask(
        self, worker: Worker, scene: Scene, rig: StereoRig, shots: list[dict[str, Any]]
    ) -> tuple[list[Float32[np.ndarray, "h w"]], float]:
        """Have the worker photograph one scene: its images, and the level of the background."""
        arrays: dict[str, Any] = {"pattern": np.asarray(scene.pattern, np.float32)}
        for index, body in enumerate(scene.bodies):
            arrays[f"vertices{index}"] = np.asarray(body.mesh.vertices, np.float32)
            arrays[f"faces{index}"] = np.asarray(body.mesh.faces, np.int32)
        np.savez(worker.folder / "scene.npz", **arrays)
        for index, shot in enumerate(shots):
            shot["file"] = str(worker.folder / f"image-{index}.npy")
        light = {name: float(value) for name, value in vars(scene.light).items()}
        worker.send(
            {
                "scene": str(worker.folder / "scene.npz"),
                "materials": [vars(body.material) for body in scene.bodies],
                "light": light
                | {
                    "tan_half_width": scene.tan_half_width,
                    "tan_half_height": scene.tan_half_height,
                },
                "rig": {"width": rig.width, "height": rig.height, "focal": rig.focal},
                "quality": {
                    "samples": self.samples,
                    "max_bounces": self.max_bounces,
                    "pixel_filter": self.pixel_filter,
                    "view_transform": self.view_transform,
                },
                "shots": shots,
            }
        )
        images = []
        for shot in shots:
            worker.receive("image", self.timeout)
            images.append(np.load(shot["file"], allow_pickle=False))
            Path(shot["file"]).unlink()
        return images, float(worker.receive("done", self.timeout)["background"])


def find_cycles() -> dict[str, str]:
    """Where Cycles is and which version, for ``doctor``.

    Returns:
        ``command`` (the program), ``blender`` and ``python`` (their versions); empty where there
        is no Blender.

    Raises:
        InputError: where QS3_BLENDER or QS3_CYCLES_PYTHON names no file.
        RenderError: where it is there and does not start.
    """
    command = interpreter()
    if command is None:
        return {}
    return {"command": command[0], **_versions(command)}


def worker_process() -> int | None:
    """Process id of this process's worker between two calls, or None where none runs."""
    command = interpreter()
    return None if command is None else idle_process(command)


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
    with borrow(command, 0) as worker:
        return {name: str(worker.greeting[name]) for name in ("blender", "python")}


def _shot(rig: StereoRig, pose: Pose, camera: Pose, region: Region, seed: int) -> dict[str, Any]:
    return {
        "camera": camera.camera_to_world.tolist(),
        "projector": rig.projector(pose).camera_to_world.tolist(),
        "region": [region.x, region.y, region.width, region.height],
        "seed": seed,
    }


def _empty(region: Region) -> Float32[np.ndarray, "h w"]:
    return np.zeros((max(0, region.height), max(0, region.width)), dtype=np.float32)
