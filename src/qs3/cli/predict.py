"""``qs3 predict``: answers of a run for files."""

from dataclasses import replace
from pathlib import Path
from typing import Annotated

import tyro

from qs3.cli.answer_files import AnswerFiles
from qs3.cli.text import notify, quoted, raise_last, show, show_row
from qs3.errors import InputError


def predict(
    run: Annotated[Path, tyro.conf.Positional],
    files: Annotated[tuple[Path, ...], tyro.conf.Positional],
    top: int = 1,
    csv: Path | None = None,
    json: Path | None = None,
    sort_into: Path | None = None,
    unknown: float | None = None,
    calibrated: bool = False,
    pose: bool = True,
    pictures: Path | None = None,
    tolerance: float | None = None,
) -> int:
    """Predict the class of each file, with its confidence.

    A file that cannot be read is reported at the end, and the exit code is 2; the others are done.

    Args:
        run: Folder of a run, its model.safetensors, or the bundled network rooms.
        files: Clouds (such as PLY, PCD, NPY, or a mesh as OFF; z up), folders with all below,
            patterns in quotes such as 'scans/*.ply', or data sets of any layout.
        top: Number of classes to print, the likeliest first.
        csv: CSV file to write; a cloud is never overwritten.
        json: JSON file to write, with the probability of every class; - prints it alone, and other
            lines go to standard error.
        sort_into: New folder with a folder per class of links to the files, to correct by hand and
            to train on.
        unknown: Answer "unknown" for unfamiliar clouds: 0.05 rejects about 5 % of known objects.
            Familiarity is printed, the share of held-out scans that are less familiar.
        calibrated: Print confidence calibrated on held-out source; that of a forest always is.
        pose: Compare each cloud with the CAD of the run, if it has some (trained with --meshes):
            it corrects the answer, and finds the pose, for --json and --csv. --no-pose is faster.
        pictures: Folder for pictures of the CAD over each cloud, the doubtful first, thirty per
            page. Replaces those of an earlier call.
        tolerance: Share by which parts may be larger or smaller than their CAD, such as 0.1: one
            scale per class, found over all of its clouds (three at least) and printed if it is not
            1. Default: the scales that qs3 adapt found.
    """
    from qs3.adaptation.names import UNKNOWN
    from qs3.answers.answer import Answer, answers_csv, answers_json, load_trained
    from qs3.answers.answer import answer as answer_clouds
    from qs3.answers.answer import sort_into as link_files
    from qs3.answers.cloud_files import is_data_set, list_clouds, read_each
    from qs3.answers.deviating import answer_within
    from qs3.checks import check_numbers, check_tolerance
    from qs3.clouds.load import refuse_inside
    from qs3.files import check_folder, refuse_taken
    from qs3.parts.pose_values import agreement_cells
    from qs3.store.bars import progress_bar

    if not files:
        raise InputError("name one or more files or folders of points after the run")
    check_numbers("--top", top)
    if pictures is not None and (not pose or pictures.is_file()):
        raise InputError(f"--pictures {pictures}: names a folder, and needs the pose")
    if tolerance is not None:
        check_tolerance(tolerance)
        if not pose:
            raise InputError(f"--tolerance {tolerance:g}: compares with CAD; leave --no-pose out")
    if pictures is not None:
        from qs3.report.scans import POSES, earlier_sheets  # matplotlib takes as long as an answer

        earlier_sheets(pictures / POSES)
        check_folder(pictures)
    # Before all clouds are answered: what is in the way of the answers would lose them.
    if sort_into is not None:
        refuse_taken(sort_into)
        refuse_inside(sort_into, files)
    paths = list_clouds(files)
    tables = AnswerFiles({"csv": csv, "json": json}, paths, {"pictures": pictures}, sort_into)
    sets = any(map(is_data_set, paths))
    if sets and sort_into is not None:
        raise InputError(
            "--sort-into links to files, and the clouds of a data set are none; write files of it "
            "first: qs3 convert DATA FOLDER --to ply"
        )
    text = "predict" if sets or len(paths) > 1 else None
    model = load_trained(run)
    if pictures is not None and model.witness is None:
        raise InputError(f"--pictures {pictures}: shows CAD, and {run} has none (train --meshes)")
    options = {"unknown": unknown, "calibrated": calibrated, "name": run}
    if tolerance is None:
        each = answer_clouds(model, read_each(paths), pose=pose, **options)
    else:
        from qs3.parts.deviation import lines_of  # it imports numba

        each, _, deviations = answer_within(model, [*read_each(paths)], tolerance, **options)
        notify(*lines_of(deviations, tolerance))
    if pictures is None:  # the clouds of many files need not lie in memory at once
        each = (replace(answer, points=None, features=None) for answer in each)
    answers: list[Answer] = []
    texts = {"csv": lambda: answers_csv(answers, top), "json": lambda: answers_json(answers)}
    with tables.kept(answers, **texts):
        for answer in progress_bar(None if sets else len(paths), text, "cloud", items=each):
            answers.append(answer)
            if answer.best() and not tables.is_printed:
                cells = [cell for name, s in answer.best(top) for cell in (name, f"{s:.3f}")]
                if answer.familiarity is not None:
                    cells.append(f"familiarity {answer.familiarity:.3f}")
                if (found := answer.found) is not None:
                    cells += [found.cad, *agreement_cells(found.residual, found.visible)]
                cells += ["lost"] if answer.lost else []
                show_row(answer.file, *cells)
    if pictures is not None:
        from qs3.report.scans import draw_poses

        (notify if tables.is_printed else show)(*draw_poses(pictures, answers))
    refused = any(answer.refused for answer in answers)
    if sort_into is not None:
        link_files(sort_into, answers)
        more = f", move or remove what is in {sort_into / UNKNOWN} (it would become a class)"
        notify(f"links by class in {sort_into}: move what is wrong{more if refused else ''}; then "
             f"qs3 train --source {quoted(sort_into)}")  # fmt: skip
    faults = [answer.fault for answer in answers if answer.fault]
    raise_last(faults, len(answers), "clouds" if sets else "files")
    return 0
