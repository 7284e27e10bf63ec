"""``qs3 scan``: one mesh through the whole sensor, with pictures."""

import dataclasses
import time
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
import tyro

from qs3.cli.options import Flat
from qs3.cli.text import notify, show
from qs3.sensor.stage.settings import ScanSettings


def scan(
    mesh: Annotated[str, tyro.conf.Positional],
    out: Path,
    up: Literal["z", "y"] | None = None,
    frames: bool = False,
    neighbour: str = "",
    class_name: str = "",
    settings: Flat[ScanSettings] = ScanSettings(),  # noqa: B008
) -> int:
    """Scan one mesh: noisy cloud, clean twin, a picture of every stage.

    Args:
        mesh: A mesh file (OFF, OBJ, PLY, STL, GLB, GLTF, STEP, IGES, 3MF), a built-in class (chair,
            …) or part (flange, …).
        out: Folder to write: cloud.ply, clean.ply, montage.png, scan.json.
        up: Up axis of the mesh files; default: y for glTF, z for all others.
        frames: Also write whole frames in BOP's scene layout into frames/. Whole frames are matched
            then, so a few points of the cloud differ.
        neighbour: Mesh file or built-in class that stands in front (scene behind) or beside.
        class_name: Class of a mesh file (chair, …), for --object-size class.
        settings: Settings of the scan.
    """
    from qs3.clouds.ply_writer import write_ply
    from qs3.files import claim_folder, folder_lock, write_json
    from qs3.meshes.collections import load_named
    from qs3.report.figure import write_png
    from qs3.report.montage import montage
    from qs3.sensor.bop import remove_frames, write_frames
    from qs3.sensor.light.pattern import pattern_image
    from qs3.sensor.scan import scan as scan_mesh
    from qs3.store.scan_item import mean_statistics

    start = time.perf_counter()
    claim_folder(out, "scan.json", make=False)
    origin: dict[str, Any]
    shape, origin = load_named(mesh, settings.seed, up)
    beside = None
    if neighbour:
        # Its own draw: a chair beside a chair is another one.
        beside, origin["neighbour"] = load_named(neighbour, settings.seed + 1, up)
    settings = settings.with_renderer()
    names = [class_name or _class(origin), _class(origin.get("neighbour", {}))]
    result = scan_mesh(shape, settings, neighbour=beside, class_names=names, keep_images=True,
                       full_frames=frames)  # fmt: skip
    # Everything is computed before the folder is made: a fault leaves nothing behind.
    seen = [view.object_pixels for view in result.views]
    best = seen.index(max(seen))
    title = f"{origin['name']} · sensor {result.sensor.name} · view {best + 1} of {len(seen)}"
    clouds = {"noisy cloud": result.points, "clean twin": result.clean}
    pattern = pattern_image(result.sensor.pattern)
    unit = "m" if result.sensor.metric else "mesh units"
    figure = montage(result.images[best], clouds, pattern, unit, title)
    origin |= {"up": up, "class_name": names[0]}
    record = _record(settings, origin, result) | {"frames": frames}
    folder = claim_folder(out, "scan.json")
    with folder_lock(folder):
        # The record first: it marks the folder as ours, should this be stopped in between.
        write_json(folder / "scan.json", record)
        replaced = (folder / "cloud.ply").is_file()
        remove_frames(folder / "frames")
        write_ply(folder / "cloud.ply", result.points, result.view)
        write_ply(folder / "clean.ply", result.clean, result.clean_view)
        write_png(folder / "montage.png", figure)
        if frames:
            write_frames(folder / "frames", result)
    written = [folder / n for n in ("cloud.ply", "clean.ply", "montage.png", "scan.json")]
    show(*written, *[folder / "frames"] * frames)
    if replaced:
        notify(f"{folder}: the scan that was there is replaced")
    means = mean_statistics(result.views)
    mean = {name: np.nan if value is None else value for name, value in means.items()}
    notify(
        f"{len(result.views)} views, {result.fused_points} fused points: disparity σ "
        f"{mean['disparity_sigma']:.3f} px, bias {mean['disparity_bias']:+.3f} px, gross errors "
        f"{mean['gross_share']:.1%}, valid {mean['valid_fraction']:.0%} of the object's pixels; "
        f"{time.perf_counter() - start:.1f} s. Look at {folder / 'montage.png'}"
    )
    return 0


def _class(origin: dict[str, Any]) -> str:
    """Class of a built-in shape; a file's is not known."""
    return origin["name"] if origin.get("source") == "shapes" else ""


def _record(settings: ScanSettings, origin: dict[str, Any], result: Any) -> dict[str, Any]:
    from qs3.evaluation import versions
    from qs3.sensor.presets import settings_dict
    from qs3.sensor.stage.settings import renderer_dict

    views = [
        dataclasses.asdict(view) | {"camera_to_world": pose.camera_to_world.tolist()}
        for view, pose in zip(result.views, result.poses, strict=True)
    ]
    return {
        "mesh": origin,
        "seed": settings.seed,
        "settings": settings.as_dict(),
        "sensor": settings_dict(result.sensor),
        "drawn": result.drawn,
        "renderer": renderer_dict(settings.make_renderer()),
        "yaw": result.yaw,
        "fused_points": result.fused_points,
        "views": views,
        "seconds": {name: round(value, 4) for name, value in result.seconds.items()},
        "versions": versions("numba", "llvmlite"),  # what compiles the matcher
    }
