"""``qs3 locate``: class, CAD file and pose of parts in scans, from their CAD alone."""

from pathlib import Path
from typing import Annotated

import tyro

from qs3.cli.answer_files import AnswerFiles
from qs3.cli.text import notify, quoted, raise_last, show_row
from qs3.errors import InputError
from qs3.meshes.sizes import Unit


def locate(
    cad: Annotated[str, tyro.conf.Positional],
    scans: Annotated[tuple[Path, ...], tyro.conf.Positional],
    units: Unit | None = None,
    classes: tuple[str, ...] = (),
    on_table: bool = False,
    camera: tuple[float, float, float] | None = None,
    csv: Path | None = None,
    json: Path | None = None,
    library: Path | None = None,
    tolerance: float = 0.0,
) -> int:
    """Find the part in each scan: class, CAD file, pose, residual and visible share.

    Nothing is simulated and nothing is trained: the visible surface of each CAD in its best pose is
    compared with the scan. A scan that no pose explains is lost. A file that cannot be read is
    reported at the end, and the exit code is 2; the others are done.

    Args:
        cad: Folder of CAD, one file or one folder per class (STL, OBJ, PLY, OFF, GLB, 3MF, STEP);
            or a run with CAD, or a file that --library kept.
        scans: Clouds of one part each, in metres: files, folders with all below, patterns in
            quotes. If objects.csv of qs3 segment lies beside them, it names table and camera.
        units: Unit of the CAD files, except STEP and IGES; default: the file's, else m up to a
            longest side of 5, mm above.
        classes: Classes to look for; default: all.
        on_table: All scans have z up and the table at z = 0.
        camera: Place of the camera in the axes of the scans, metres: 0 0 0 for scans in the axes of
            a camera. It makes the answer faster and better.
        csv: CSV file to write.
        json: JSON file to write, with the 4×4 pose and all CAD files; - prints it.
        library: File to keep what cameras see of the CAD, and to take it from if it is there.
        tolerance: Share by which parts may be larger or smaller than their CAD, such as 0.1: one
            scale per class, found over all of its scans (three at least), and printed if it is not
            1.
    """
    from qs3.answers.cloud_files import is_data_set, list_clouds
    from qs3.checks import check_tolerance
    from qs3.parts.deviation import lines_of
    from qs3.parts.locate_files import (
        ScanAnswer,
        answers_csv,
        answers_json,
        is_cad_folder,
        library_of,
        locate_files,
        locate_within,
    )
    from qs3.store.bars import progress_bar

    if not scans:
        raise InputError("name one or more files or folders of scans after the folder of CAD")
    check_tolerance(tolerance)
    try:
        paths = list_clouds(scans)
        if sets := [path for path in paths if is_data_set(path)]:
            raise InputError(
                f"{sets[0]}: is a data set; write a file of each cloud first: qs3 convert DATA "
                "FOLDER --to ply"
            )
        tables = AnswerFiles({"csv": csv, "json": json}, paths, {"library": library})
        parts = library_of(cad, units, classes, library)
    except InputError as error:
        if is_cad_folder(cad):
            from qs3.workflow.inputs import refuse_swapped  # it loads trimesh

            refuse_swapped(Path(cad), scans[0], error)
        raise
    if tolerance:
        each, deviations = locate_within(parts, paths, tolerance, on_table=on_table, camera=camera)
        notify(*lines_of(deviations, tolerance))
    else:
        located = locate_files(parts, paths, on_table=on_table, camera=camera)
        each = progress_bar(len(paths), "locate", "scan", items=located)
    answers: list[ScanAnswer] = []
    texts = {"csv": lambda: answers_csv(answers), "json": lambda: answers_json(answers)}
    with tables.kept(answers, **texts):
        for answer in each:
            answers.append(answer)
            if answer.location is not None and not tables.is_printed:
                show_row(answer.file, *answer.cells())
    seen = [answer.location for answer in answers if answer.location is not None]
    lost = sum(location.lost for location in seen)
    if lost:
        notify(f"{lost} of {len(seen)} scans are lost: no pose of any CAD agrees with them")
    if seen and 2 * lost > len(seen):
        sizes = f"qs3 meshes {quoted(cad)} prints sizes;" if is_cad_folder(cad) else "make it with"
        notify(f"Is the unit of {cad} right ({sizes} --units)? Does each scan hold one part, in "
               "metres, without the table (qs3 segment)?")  # fmt: skip
    faults = [answer.fault for answer in answers if answer.fault]
    raise_last(faults, len(answers), "scans")
    return 0
