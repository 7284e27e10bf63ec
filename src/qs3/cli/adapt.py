"""``qs3 adapt``: the whole way for your own parts, in five commands that each can be repeated."""

import shlex
from pathlib import Path
from typing import Annotated, Literal

import tyro

from qs3.cli.text import show, tell
from qs3.errors import InputError
from qs3.files import claim_folder, write_json
from qs3.meshes.sizes import Unit
from qs3.store.failures import FAILURES

_MARKER = "adapt.json"
_LEARN = ("train", "--model", "forest", "--source-cloud", "all")


def adapt(
    cad: Annotated[Path, tyro.conf.Positional],
    scans: Annotated[Path, tyro.conf.Positional],
    out: Path = Path("adapted"),
    camera: str = "d435",
    units: Unit | None = None,
    up: Literal["z", "y"] | None = None,
    labels: Path | None = None,
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
        method: Rounds of self-training on the scans, or none.
        unknown: Share of known objects that may be rejected as "unknown", as in qs3 predict.
        fit: Align the CAD of the four likeliest classes to each scan; about 0.3 s a scan.
        workers: Processes that scan; default: all cores.
        seed: Root of all random steps.
    """
    from qs3.cli import run

    for folder in (cad, scans):
        if not folder.exists():
            raise InputError(f"{folder}: no such file or folder")
    source, made, answers = out / "source", out / "run", out / "answers.csv"
    report, sheet = out / "report.html", out / "contact-sheet.png"
    files = _options(meshes=cad, units=units, up=up)
    scanned = _options(sensor=camera, seed=seed, workers=workers, out=source)
    learnt = _options(source=source, target=scans, method=method, labels=labels, seed=seed)
    laid = ["--fit"] if fit else []
    steps = [
        ["meshes", str(cad), *files[2:], *_options(out=sheet)],
        ["generate", "--recipe", "parts", *files, *scanned],
        [*_LEARN, *learnt, *files, *_options(out=made)],
        ["predict", str(made), str(scans), *_options(unknown=unknown, csv=answers), *laid],
        ["report", str(made), *_options(source=source, out=report)],
    ]
    claim_folder(out, _MARKER)
    write_json(out / _MARKER, {"cad": str(cad), "scans": str(scans), "camera": camera})
    code, faults = 0, []
    for words in steps:
        tell("", f"qs3 {shlex.join(words)}")
        if words[0] == "predict":
            answers.unlink(missing_ok=True)  # of an earlier call
        try:
            code = max(code, run(words))
        except InputError as error:
            # Some meshes that cannot be scanned, or scans that cannot be read, stop no other step.
            partial = str(error).startswith(str(source / FAILURES))
            if not partial and not (words[0] == "predict" and answers.is_file()):
                raise
            faults.append(error)
    show(answers, report)
    if faults:
        raise faults[0]
    return code


def _options(**values: object) -> list[str]:
    words = [(f"--{name}", str(value)) for name, value in values.items() if value is not None]
    return [word for pair in words for word in pair]
