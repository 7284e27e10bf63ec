"""``qs3 find``: the parts on a table in depth pictures, from their CAD alone."""

from collections import Counter
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import tyro

from qs3.cli.answer_files import AnswerFiles
from qs3.cli.options import Flat
from qs3.cli.text import notify, raise_last, show_row
from qs3.errors import InputError
from qs3.meshes.sizes import Unit
from qs3.parts.pose_values import agreement_cells
from qs3.parts.scenes.found import FindSettings, FoundParts

_FEW = 0.25
"""Points of parts, per point that no part explains, below which the units are asked about: a wrong
part may be sure."""


def find(
    cad: Annotated[str, tyro.conf.Positional],
    frames: Annotated[tuple[Path, ...], tyro.conf.Positional],
    settings: Flat[FindSettings] = FindSettings(),  # noqa: B008
    intrinsics: str = "",
    depth_scale: float | None = None,
    units: Unit | None = None,
    classes: tuple[str, ...] = (),
    masks: Path | None = None,
    base: Path | None = None,
    csv: Path | None = None,
    json: Path | None = None,
    bop: Path | None = None,
    pictures: Path | None = None,
    library: Path | None = None,
) -> int:
    """Find the parts on a table in depth pictures: class and pose of each, and what is unexplained.

    Parts may touch, lean on each other and hide each other. Nothing is simulated and nothing is
    trained. A frame without a table, such as a full bin, is searched without one. A frame that
    cannot be read, or shows neither a table nor a part, is reported at the end, and the exit code
    is 2; the others are done.

    Args:
        cad: Folder of CAD, one file or one folder per class (STL, OBJ, PLY, OFF, GLB, 3MF, STEP); a
            library that --library wrote; or a run that has one.
        frames: Depth pictures, folders as qs3 capture writes them, scenes in BOP's layout, or
            clouds in their camera's axes.
        settings: How it is searched.
        intrinsics: Of depth pictures without their camera's file: fx,fy,cx,cy, or a file.
        depth_scale: Metres per step of depth pictures; default: the camera's, else 0.001.
        units: Unit of the CAD files, except STEP and IGES; default: the file's, else m up to a
            longest side of 5, mm above.
        classes: Classes to look for; default: all.
        masks: Masks of a detector, one per part: a folder of instance masks with the names of the
            frames, or a JSON of COCO with polygons or run lengths.
        base: Text file of 4×4 numbers, base from camera: poses are also given from a robot's base.
        csv: CSV file to write, one row per part.
        json: JSON file to write; - prints it.
        bop: Results CSV of the BOP toolkit to write.
        pictures: New folder for one picture per frame, with the outlines of the parts.
        library: File to keep what cameras see of the CAD, and to take it from if it is there. It
            can be named in place of the folder of CAD.
    """
    from qs3.objects.coco import read_coco
    from qs3.parts.locate_files import library_of
    from qs3.parts.scenes.find_files import (
        answers_bop,
        answers_csv,
        answers_json,
        check_masks,
        find_in_frames,
        read_base,
    )
    from qs3.parts.scenes.frames import check_numbers, list_frames
    from qs3.reading import naming
    from qs3.store.bars import progress_bar

    if not frames:
        raise InputError("name one or more frames or folders after the folder of CAD")
    paths = [frame for path in frames for frame in list_frames(path, intrinsics, depth_scale)]
    others = {"pictures": pictures, "library": library}
    named = {"csv": csv, "json": json, "bop": bop}
    tables = AnswerFiles(named, [frame.path for frame in paths], others)
    if bop is not None:
        if bop.suffix.lower() != ".csv":
            raise InputError(f"--bop {bop}: name a .csv file")
        with naming(f"--bop {bop}"):
            check_numbers(paths)
    if masks is not None and not masks.is_dir() and masks.suffix.lower() != ".json":
        raise InputError(f"--masks {masks}: no such folder; or name a JSON of COCO")
    held = masks if masks is None or masks.is_dir() else read_coco(masks)
    if held is not None:
        check_masks(held, paths)
    from_camera = None if base is None else read_base(base)
    if pictures is not None:
        from qs3.report.found_parts import check_pictures

        check_pictures(pictures, paths)
    parts = library_of(cad, units, classes, keep=library)
    each = find_in_frames(parts, paths, settings, held)
    names = Counter(frame.name for frame in paths)
    answers, seen, is_asked = [], [], False
    texts = {
        "csv": lambda: answers_csv(answers, from_camera),
        "json": lambda: answers_json(answers, from_camera),
        "bop": lambda: answers_bop(answers, parts),
    }
    with tables.kept(answers, **texts):
        for answer in progress_bar(len(paths), "find", "frame", items=each):
            answers.append(answer)
            if answer.found is None:
                continue
            if not tables.is_printed:
                name = answer.frame.name
                show_parts(name if names[name] == 1 else str(answer.frame.path), answer.found)
            if pictures is not None:
                from qs3.report.found_parts import write_picture

                write_picture(pictures, answer.frame, answer.found, parts)
            seen.append(answer.found)
            if len(seen) == 1:  # what is far too large takes long to search, in each frame
                is_asked = _ask_for_unit(cad, seen)
    if not is_asked:
        _ask_for_unit(cad, seen)
    raise_last([answer.fault for answer in answers if answer.fault], len(answers), "frames")
    return 0


def _ask_for_unit(cad: str, seen: Sequence[FoundParts]) -> bool:
    """Ask about units if the parts explain hardly a point of the frames; return whether it does."""
    from qs3.parts.locate_files import is_cad_folder

    explained = sum(part.points for found in seen for part in found.parts)
    left = sum(rest.points for found in seen for rest in found.unexplained)
    if explained >= _FEW * left:
        return False
    fix = "" if is_cad_folder(cad) else "make it with "
    notify(f"Parts of {cad} explain {explained} of {explained + left} points. If the others "
           f"are not foreign, is its unit right (qs3 meshes prints sizes; {fix}--units), and "
           "that of depth (--depth-scale)?")  # fmt: skip
    return True


def show_parts(frame: str, found: FoundParts) -> None:
    """Print the parts of a frame, and what no CAD explains; a turn is axis times angle."""
    import cv2

    for part in found.parts:
        x, y, z = part.pose[:3, 3]
        a, b, c = np.degrees(cv2.Rodrigues(part.pose[:3, :3])[0]).ravel()
        show_row(frame, part.class_name, part.cad, f"score {part.score:.2f}",
                 f"at {x:.3f} {y:.3f} {z:.3f}", f"turned {a:.0f} {b:.0f} {c:.0f}°",
                 *agreement_cells(part.residual, part.visible))  # fmt: skip
    for rest in found.unexplained:
        x, y, z = rest.centre
        show_row(frame, "unexplained", f"{rest.points} points", f"at {x:.3f} {y:.3f} {z:.3f}")
    if not found.parts and not found.unexplained:
        show_row(frame, "nothing on the table")
