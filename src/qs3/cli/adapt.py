"""``qs3 adapt``: the whole way for your own parts, in steps that each can be repeated."""

from pathlib import Path
from typing import Annotated, Literal

import tyro

from qs3.cli.text import show, tell
from qs3.errors import InputError
from qs3.files import claim_folder, write_json
from qs3.meshes.sizes import Unit

_MARKER = "adapt.json"


def adapt(
    cad: Annotated[Path, tyro.conf.Positional],
    scans: Annotated[Path, tyro.conf.Positional],
    out: Path = Path("adapted"),
    camera: str = "d435",
    units: Unit | None = None,
    up: Literal["z", "y"] | None = None,
    labels: Path | None = None,
    like: bool = True,
    method: Literal["qbst", "spst", "source-only"] = "qbst",
    unknown: float | None = None,
    fit: bool = False,
    workers: int | None = None,
    seed: int = 0,
) -> int:
    """Make a classifier of your own parts: CAD and unlabelled scans in, answers out.

    Draws the meshes, scans them on a table, trains a forest, adapts it and answers the scans. Each
    step prints the command that repeats it. The same command continues after a stop.

    Args:
        cad: Folder of meshes, one file or one folder a class.
        scans: Clouds of the camera, one part each, z up, in metres, as qs3 segment writes them.
        out: Folder to write: contact-sheet.png, source, run, answers.csv, report.html.
        camera: Preset of the camera (qs3 sensors), or a TOML file.
        units: Unit of the mesh files; default: the file's, else m up to a longest side of 5, mm
            above.
        up: Up axis of every mesh file; default: y for glTF, z for all others.
        labels: CSV of a few labelled scans, columns file and class (qs3 suggest writes one). The
            run is then named few-label.
        like: Scan with as many points as your scans have, and from where your camera stood, if the
            scans record it, as those of qs3 segment do. The measures are printed.
        method: Rounds of self-training on the scans, or none.
        unknown: Share of known objects that may be rejected as "unknown", as in qs3 predict.
        fit: Align the CAD of the four likeliest classes to each scan; about 0.3 s a scan. Pictures
            go to the folder fit.
        workers: Processes that scan; default: all cores.
        seed: Root of all random steps.
    """
    from qs3.cli import run
    from qs3.io.like import measure
    from qs3.sensor.presets import load_sensor
    from qs3.store.manifest import refuse_failures
    from qs3.training.adapt import adapt as adapt_parts
    from qs3.training.adapt import command, options

    for folder in (cad, scans):
        if not folder.exists():
            raise InputError(f"{folder}: no such file or folder")
    load_sensor(camera)  # faults of what was given are raised before a mesh is drawn
    measure(scans)
    claim_folder(out, _MARKER)
    write_json(out / _MARKER, {"cad": str(cad), "scans": str(scans), "camera": camera})
    answers, report = out / "answers.csv", out / "report.html"

    def do(*words: object) -> int:
        tell("", command(*words))
        return run(list(map(str, words)))

    code = do("meshes", cad, *options(units=units, up=up, out=out / "contact-sheet.png"))
    adapt_parts(cad, scans, out, camera=camera, units=units, up=up, labels=labels, like=like,
                method=method, workers=workers, seed=seed,
                say=lambda line: tell(*[""] * line.startswith("qs3 "), line))  # fmt: skip
    answers.unlink(missing_ok=True)  # of an earlier call
    pictures = ["--fit", "--pictures", out / "fit"] if fit else []
    try:
        do("predict", out / "run", scans, *options(unknown=unknown, csv=answers), *pictures)
    finally:  # faults of single scans stop no other step
        if answers.is_file():
            try:
                do("report", out / "run", *options(source=out / "source", scans=scans, out=report))
            finally:  # it has the same faults
                show(answers, report)
    fix = "the classifier has learnt from the others. To add these, repair the file and name a "
    refuse_failures(out / "source", "scans", f"{fix}new --out")
    return code
