"""``qs3 predict``: answers of a run for files."""

from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from qs3.cli.text import printable, quoted, show, tell
from qs3.errors import InputError

if TYPE_CHECKING:
    from qs3.training.answers import Answer


def predict(
    run: Annotated[Path, tyro.conf.Positional],
    files: Annotated[tuple[Path, ...], tyro.conf.Positional],
    top: int = 1,
    csv: Path | None = None,
    json: Path | None = None,
    sort_into: Path | None = None,
    unknown: float | None = None,
    calibrated: bool = False,
    fit: bool = False,
    floor: float | None = None,
    pictures: Path | None = None,
) -> int:
    """Predict the class of each file, with its confidence.

    A file that cannot be read is reported at the end, and the exit code is 2; the others are done.

    Args:
        run: Folder of a run, its model.safetensors, or the bundled network rooms.
        files: Clouds (NPY, XYZ, PLY, PCD, or a mesh as OFF; z up), folders with all below, patterns
            in quotes such as 'scans/*.ply', or data sets of any layout.
        top: Number of classes to print, the likeliest first.
        csv: CSV file to write; a cloud is never overwritten.
        json: JSON file to write, with the probability of every class; - prints it.
        sort_into: New folder with a folder per class of links to the files, to correct by hand and
            to train on.
        unknown: Share of known objects that may be rejected as "unknown", such as 0.05: rejects
            what is less familiar than this share of the held-out source.
        calibrated: Print confidence calibrated on held-out source.
        fit: Align the CAD of the four likeliest classes to each cloud (run trained with --meshes).
            The residuals join the decision; --json has the pose.
        floor: z of the floor in metres, for clouds without it: 0 if they stand on z = 0. rooms uses
            the height above the floor if it is known.
        pictures: Folder for pictures of the CAD over each cloud, thirty a page; goes with --fit.
    """
    from qs3.adaptation.confidence import UNKNOWN
    from qs3.files import check_output, refuse_taken, write_text
    from qs3.store.progress import progress_bar
    from qs3.training import answers as table

    if not files:
        raise InputError("name one or more files or folders of points after the run")
    if top < 1:
        raise InputError(f"--top {top}: must be at least 1")
    if pictures is not None and (not fit or pictures.is_file()):
        raise InputError(f"--pictures {pictures}: names a folder, and goes with --fit")
    # Before all clouds are told: what is in the way of the answers would lose them.
    if sort_into is not None:
        refuse_taken(sort_into)
    paths = table.list_clouds(files)
    for option, file in (("csv", csv), ("json", json)):
        if file is not None and (option, file) != ("json", Path("-")):
            _refuse_cloud(option, file, paths)
            check_output(file, f"--{option}", f".{option}")
    sets = any(map(table.is_data_set, paths))
    if sets and sort_into is not None:
        raise InputError(
            "--sort-into links to files, and the clouds of a data set are none; write files of it "
            "first: qs3 convert DATA FOLDER --to ply"
        )
    text = "predict" if sets or len(paths) > 1 else None
    said = table.predict_files(run, paths, unknown=unknown, calibrated=calibrated, fit=fit,
                               floor=floor)  # fmt: skip
    bar = progress_bar(None if sets else len(paths), text, "cloud", items=said)
    answers: list[table.Answer] = [*bar]
    if json == Path("-"):
        show(table.answers_json(answers, ascii=True), end="")
    else:
        for answer in answers:
            if answer.best():
                parts = [f"{printable(name, keep='')}\t{s:.3f}" for name, s in answer.best(top)]
                if answer.fit is not None:
                    laid = answer.fit.fit
                    parts.append(f"residual {1000 * laid.residual:.1f} mm")
                    parts.append(f"coverage {laid.coverage:.0%}")
                show("\t".join([printable(str(answer.file), keep=""), *parts]))
    if csv is not None:
        write_text(csv, table.answers_csv(answers, top))
    if json is not None and json != Path("-"):
        write_text(json, table.answers_json(answers))
    if pictures is not None:
        show(*_draw(pictures, answers))
    if any(answer.refused for answer in answers):
        tell("the number of an unknown is no probability: it is the share of held-out simulated "
             "scans that are more familiar than this scan")  # fmt: skip
    if sort_into is not None:
        table.sort_into(sort_into, answers)
        first = "move what is wrong"
        if any(answer.refused for answer in answers):
            first += f", move or remove what is in {sort_into / UNKNOWN} (it would become a class)"
        tell(f"links by class in {sort_into}: {first}; then qs3 train --source {quoted(sort_into)}")
    faults = [answer.fault for answer in answers if answer.fault]
    for fault in faults[:-1]:
        tell(f"qs3: {printable(fault, keep='')}")
    if faults:
        kind = "clouds" if sets else "files"
        count = f" ({len(faults)} of {len(answers)} {kind})" if len(answers) > 1 else ""
        raise InputError(faults[-1] + count)
    return 0


def _draw(folder: Path, answers: "Sequence[Answer]") -> list[Path]:
    """Draw the CAD of each answer over its cloud."""
    from trimesh import transform_points

    from qs3.report.clouds import caption
    from qs3.report.figure import short
    from qs3.report.scans import Tile, write_sheets

    tiles = []
    for answer in answers:
        if answer.fit is not None and answer.points is not None:
            edges, fit = answer.fit.part.edges, answer.fit.fit
            lines = transform_points(edges.reshape(-1, 3), fit.pose).reshape(-1, 2, 3)
            (name, share), *_ = answer.best()
            text = f"{caption(answer.file.name)}\n{short(name)} {share:.2f}"
            text += f", {1000 * fit.residual:.1f} mm, {fit.coverage:.0%}"
            tiles.append(Tile(answer.points, text, lines))
    return write_sheets(folder / "fit.png", tiles)


def _refuse_cloud(option: str, file: Path, clouds: Sequence[Path]) -> None:
    """Refuse to write a table over a cloud that is read."""
    there = file.exists()
    for cloud in clouds:
        same = there and cloud.exists() and file.samefile(cloud)
        if same or file.absolute() == cloud.absolute():
            raise InputError(
                f"--{option} {file}: is one of the clouds to read, and would be overwritten; name "
                "another file"
            )
