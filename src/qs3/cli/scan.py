"""``qs3 scan``: one mesh through the whole sensor, with pictures."""

import dataclasses
import sys
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro

from qs3.cli.camera import CameraOptions
from qs3.cli.scene import SceneOptions
from qs3.errors import InputError
from qs3.files import claim_folder, sha256, write_bytes, write_json


@dataclass(frozen=True)
class ScanOptions:
    """Photograph one mesh: its noisy cloud, the clean twin and a picture of every stage."""

    mesh: Annotated[str, tyro.conf.Positional]
    """A mesh file (OFF, OBJ, PLY, STL, GLB, GLTF) or the name of a built-in class (chair, …)."""
    out: Path
    """Folder to write: cloud.ply, clean.ply, montage.png, scan.json."""
    seed: int = 0
    """All random steps follow from it."""
    up: Literal["z", "y"] | None = None
    """Up axis of the mesh file; by default y for glTF, z for all others."""
    save_images: bool = False
    """Also write the grey pair, the 16-bit depth and the camera of each view, object's part."""
    frames: bool = False
    """Also write whole frames in BOP's scene layout, into frames/: grey pair, depth, true depth,
    masks, normals, cameras and poses."""
    neighbour: str = ""
    """Mesh file or built-in class that stands in front (scene behind) or beside."""
    scene: Annotated[SceneOptions, tyro.conf.arg(name="")] = field(default_factory=SceneOptions)
    """What stands around the object, and what is kept."""
    camera: Annotated[CameraOptions, tyro.conf.arg(name="")] = field(default_factory=CameraOptions)
    """The simulated camera."""


def scan(options: Annotated[ScanOptions, tyro.conf.arg(name="")]) -> int:
    """Photograph one mesh: noisy cloud, clean twin, a picture of every stage, and statistics."""
    from qs3.io.ply import write_ply
    from qs3.report.figure import write_png
    from qs3.report.montage import montage, montage_view
    from qs3.sensor.frames import write_frames
    from qs3.sensor.scan import scan as scan_mesh

    start = time.perf_counter()
    if options.seed < 0:
        raise InputError(f"--seed {options.seed}: must not be negative")
    mesh, origin = load_named(options.mesh, options.seed, options.up)
    sensor = options.scene.resolve_sensor(options.camera.resolve_sensor())
    settings = options.camera.scan_arguments() | options.scene.scan_arguments(sensor)
    beside = None
    if options.neighbour:
        # Its own draw: a chair beside a chair is another one.
        beside, origin["neighbour"] = load_named(options.neighbour, options.seed + 1)
    renderer = options.camera.resolve_renderer()
    result = scan_mesh(
        mesh,
        sensor=sensor,
        seed=options.seed,
        renderer=renderer,
        neighbour=beside,
        keep_images=True,
        full_frames=options.frames,
        **settings,
    )
    sensor = result.sensor
    # Everything is computed before the folder is touched: a fault leaves nothing behind.
    view, best = montage_view(result)
    title = f"{origin['name']} · sensor {sensor.name} · view {best + 1} of {len(result.views)}"
    figure = montage(view, title)
    record = _record(options.seed, settings, sensor, renderer, origin, result)
    folder = claim_folder(options.out, "scan.json")
    # The record first: it marks the folder as ours, should this be stopped in between.
    write_json(folder / "scan.json", record)
    for stale in folder.glob("view-*-*.*"):  # of an earlier scan into this folder
        stale.unlink()
    write_ply(folder / "cloud.ply", result.points, result.view)
    write_ply(folder / "clean.ply", result.clean, result.clean_view)
    write_png(folder / "montage.png", figure)
    written = ["cloud.ply", "clean.ply", "montage.png", "scan.json"]
    if options.save_images:
        written += _save_images(folder, result, sensor)
    if options.frames:
        write_frames(folder / "frames", result)
        written.append("frames")
    for name in written:
        print(folder / name)
    _tell(result, time.perf_counter() - start, folder)
    return 0


def load_named(
    name: str, seed: int, up: Literal["z", "y"] | None = None
) -> tuple[Any, dict[str, Any]]:
    """Return the mesh of a file or a built-in class, and where it is from.

    Raises:
        InputError: where it is neither, or the file holds no mesh.
    """
    from qs3 import shapes
    from qs3.meshes import load_mesh

    if name in shapes.CLASSES and not Path(name).exists():
        return shapes.make(name, seed=seed), {"name": name, "source": "shapes", "sha256": ""}
    path = Path(name)
    if not path.suffix and not path.exists():
        raise InputError(
            f"{name}: neither a mesh file nor a built-in class ({', '.join(shapes.CLASSES)})"
        )
    return load_mesh(path, up), {"name": path.name, "source": "file", "sha256": sha256(path)}


def _record(
    seed: int, settings: dict[str, Any], sensor: Any, renderer: Any, origin: Any, result: Any
) -> dict[str, Any]:
    from qs3.evaluation import versions
    from qs3.sensor.presets import settings_dict

    views = [
        dataclasses.asdict(view) | {"camera_to_world": pose.camera_to_world.tolist()}
        for view, pose in zip(result.views, result.poses, strict=True)
    ]
    return {
        "mesh": origin,
        "seed": seed,
        "settings": settings | {"scene": dataclasses.asdict(settings["scene"])},
        "sensor": settings_dict(sensor),
        "drawn": result.drawn,
        "renderer": {**dataclasses.asdict(renderer), **renderer.description},
        "yaw": result.yaw,
        "fused_points": result.fused_points,
        "views": views,
        "seconds": {name: round(value, 4) for name, value in result.seconds.items()},
        "versions": versions(),
    }


def _save_images(folder: Path, result: Any, sensor: Any) -> list[str]:
    """Write the pictures of each view; depth in steps of 1/10,000 of the unit, 0 where none."""
    import cv2

    names = []
    for index, (images, pose) in enumerate(zip(result.images, result.poses, strict=True)):
        if not images.left.size:  # the object is out of this view's sight
            continue
        depth = np.nan_to_num(np.clip(np.rint(images.depth * 1e4), 0, 65535)).astype(np.uint16)
        true = np.nan_to_num(np.clip(np.rint(images.true_depth * 1e4), 0, 65535)).astype(np.uint16)
        pictures = {"left": images.left, "right": images.right, "depth": depth, "true-depth": true}
        for kind, image in pictures.items():
            name = f"view-{index}-{kind}.png"
            write_bytes(folder / name, cv2.imencode(".png", image)[1].tobytes())
            names.append(name)
        cx, cy = sensor.rig.principal_point
        camera = {
            "width": images.region.width,
            "height": images.region.height,
            "focal": sensor.rig.focal,
            "principal_point": [cx - images.region.x, cy - images.region.y],
            "region_of_frame": list(images.region.bounds),
            "frame": [sensor.rig.width, sensor.rig.height],
            "baseline": sensor.rig.baseline,
            "depth_unit": 1e-4,
            "camera_to_world": pose.camera_to_world.tolist(),
            "world": "the mesh in its object size, turned about z by yaw (scan.json)",
        }
        write_json(folder / f"view-{index}-camera.json", camera)
        names.append(f"view-{index}-camera.json")
    return names


def _tell(result: Any, seconds: float, folder: Path) -> None:
    def mean(name: str) -> float:
        values = [getattr(view, name) for view in result.views]
        known = [value for value in values if value is not None]
        return float(np.mean(known)) if known else float("nan")

    print(
        f"{len(result.views)} views, {result.fused_points} fused points: disparity σ "
        f"{mean('disparity_sigma'):.3f} px, bias {mean('disparity_bias'):+.3f} px, gross errors "
        f"{mean('gross_share'):.1%}, valid {mean('valid_fraction'):.0%} of the object's pixels; "
        f"{seconds:.1f} s. Look at {folder / 'montage.png'}",
        file=sys.stderr,
    )
