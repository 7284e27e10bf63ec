"""``qs3 adapt``: the whole way for your own parts, in steps that each can be repeated."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import numpy as np
import tyro

from qs3.cli.options import Flat
from qs3.cli.text import columns, notify, raise_last, show
from qs3.workflow.options import AdaptOptions, Written

if TYPE_CHECKING:
    from qs3.workflow.adapt import Adapted, Step


def adapt(
    cad: Annotated[Path, tyro.conf.Positional],
    scans: Annotated[tuple[Path, ...], tyro.conf.Positional],
    out: Path = Path("adapted"),
    dry_run: bool = False,
    options: Flat[AdaptOptions] = AdaptOptions(),  # noqa: B008
) -> int:
    """Make a classifier of your own parts: CAD and unlabelled scans in, answers out.

    Draws the meshes, scans them on a table, trains a forest, and answers the scans by forest and
    CAD. Each step prints the command that repeats it. The same command continues after a stop. A
    scan that cannot be used is reported at the end, and the exit code is 2; the others are done.

    Args:
        cad: Folder of meshes, one file or one folder per class.
        scans: Clouds of the camera, one part each, z up, in metres, as qs3 segment writes them:
            their folder, or files and folders.
        out: Folder to write: contact-sheet.png, source, run, answers.csv, poses.json, parts.html
            (scans under their CAD, the doubtful first, to label), poses, report.html.
        dry_run: Check all inputs and print the commands; write nothing.
        options: Options of the way.
    """
    from qs3.errors import InputError
    from qs3.files import claim_folder
    from qs3.report.figure import check_picture
    from qs3.report.page import check_page
    from qs3.report.scans import POSES, earlier_sheets
    from qs3.store.manifest import refuse_failures
    from qs3.workflow.adapt import MARKER, Adapted, steps

    if not scans:
        raise InputError("name the scans after the CAD: their folder, or files")
    claim_folder(out, MARKER, make=False)
    for name in (Written.PAGE, Written.PARTS_PAGE):
        check_page(out / name)
    check_picture(out / Written.SHEET)
    earlier_sheets(out / Written.PICTURES / POSES)
    adapted = None
    for step in steps(cad, list(scans), out, options, dry_run=dry_run):
        if step.command:
            notify("", step.command)
        notify(*step.lines)
        if step.verb == "meshes" and not step.command and not dry_run:
            _draw_meshes(step, cad, out / Written.SHEET)
        adapted = step.result
    if not isinstance(adapted, Adapted):
        return 0
    _report(adapted, out, options)
    faults = [answer.fault for answer in adapted.answers if answer.fault]
    raise_last(faults, len(adapted.answers), "scans", out / Written.ANSWERS)
    fix = "the classifier has learnt from the others. To add these, repair the file and name a "
    refuse_failures(out / Written.SOURCE, "simulated scans", f"{fix}new --out")
    return 0


def _draw_meshes(step: "Step", cad: Path, sheet: Path) -> None:
    """Tell sizes and faults; draw the sheet unless it is newer than the CAD."""
    from qs3.cli.meshes import show_meshes

    files = [look.item.path for look in step.result if look.item.path is not None]
    drawn = sheet.stat().st_mtime if sheet.is_file() else 0.0
    is_old = any(file.stat().st_mtime >= drawn for file in files)
    show_meshes(step.result, sheet if is_old else None, cad.name, as_messages=True)


def _report(adapted: "Adapted", out: Path, options: AdaptOptions) -> None:
    from qs3.files import write_json
    from qs3.report.collect import collect, named_below
    from qs3.report.page import write_report
    from qs3.report.parts_page import write_parts_page
    from qs3.report.scans import draw_poses
    from qs3.workflow.adapt import describe
    from qs3.workflow.labels import LEARNT
    from qs3.workflow.options import command

    csv, page, source = (out / name for name in (Written.ANSWERS, Written.PAGE, Written.SOURCE))
    pictures = draw_poses(out / Written.PICTURES, adapted.answers)
    scans = adapted.scans.folder
    words = ("--source", source, "--scans", scans, "--out", page)
    if adapted.scans.fill_folder:
        notify("", command("report", adapted.run, *words))
    source_clouds = adapted.source.select(np.unique(adapted.source.scan_rows()))
    answers = adapted.answers
    write_report(page, collect(adapted.run, source=source_clouds, scans=answers, below=scans))
    parts = out / Written.PARTS_PAGE
    names = adapted.classifier.class_names
    learnt = {
        named_below(answer.file, scans): adapted.labels[file]
        for answer in answers
        if (file := answer.file.resolve()) in adapted.labels
    }
    write_parts_page(parts, answers, names, scans, learnt)
    if learnt:
        write_json(adapted.run / LEARNT, learnt)
    notify("")
    show(*columns(adapted.summary(), 1), csv, out / Written.POSES, page, parts, *pictures)
    notify(*describe(adapted, parts))
