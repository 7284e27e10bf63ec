"""``qs3 segment``: the objects of a table or a floor, one cloud each."""

from pathlib import Path
from typing import Annotated

import tyro

from qs3.cli.options import Flat
from qs3.cli.text import columns, notify, quoted, raise_last, show, show_row
from qs3.errors import InputError
from qs3.objects.scene_files import (
    PICTURE,
    TABLE,
    SceneSettings,
    list_scenes,
    segment_scene,
    segment_scenes,
)


def segment(
    scene: Annotated[Path, tyro.conf.Positional],
    out: Path,
    settings: Flat[SceneSettings] = SceneSettings(),  # noqa: B008
) -> int:
    """Cut scans of a table or a floor into the objects that stand on it.

    Of a folder each scene becomes a folder of its objects. Scenes that cannot be read or have no
    object are reported at the end, and the exit code is 2. After a stop the same command goes on.

    Args:
        scene: A cloud in metres (such as PLY, PCD, NPY); with --intrinsics a depth image (16-bit
            PNG, TIFF, npy); or a folder of them, as qs3 capture writes it.
        out: New folder for a PLY file per object, z up in metres, objects.csv, and scene.png: the
            scene with a numbered box per object.
        settings: How it is cut.
    """
    from qs3.report.scans import draw_scene

    if scene.is_dir():
        return _segment_folder(scene, out, settings)
    objects = segment_scene(scene, out, settings, draw_scene(settings))
    rows = [["object", "points", "x", "y", "length", "width", "height", "heading"]]
    for number, item in enumerate(objects):
        numbers = [f"{value:.3f}" for value in (*item.centre[:2], *item.size)]
        name, count = f"object_{number:03d}", str(len(item.points))
        rows.append([name, count, *numbers, f"{item.heading:.0f}°"])
    show(*columns(rows, 1))
    notify(f"{len(objects)} objects in {out}, in metres; see {TABLE} and {PICTURE}. "
         f"Next: qs3 predict RUN {quoted(out)}")  # fmt: skip
    return 0


def _segment_folder(folder: Path, out: Path, settings: SceneSettings) -> int:
    from qs3.report.scans import draw_scene
    from qs3.store.bars import progress_bar

    scenes, settings = list_scenes(folder, settings)
    faults, objects, before = [], 0, 0
    done = segment_scenes(scenes, out, settings, draw_scene(settings))
    for name, result in progress_bar(len(scenes), "segment", "scene", items=done):
        if isinstance(result, InputError):
            faults.append(str(result))
        elif result is None:
            before += 1
        else:
            objects += len(result)
            show_row(name, f"{len(result)} objects")
    cut = len(scenes) - before - len(faults)
    if cut or before:
        notify(f"{objects} objects of {cut} scenes in {out}, in metres; {before} scenes were there "
             f"before. Next: qs3 predict RUN {quoted(out)}")  # fmt: skip
    raise_last(faults, len(scenes), "scenes failed")
    return 0
