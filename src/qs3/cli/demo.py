"""``qs3 demo``: the way for own parts: eight built-in ones and a simulated camera, or yours."""

import csv
import time
from collections.abc import Collection
from pathlib import Path

from qs3.cli.text import columns, show, tell
from qs3.errors import InputError
from qs3.files import claim_folder, read_json, write_bytes, write_json
from qs3.store.failures import FAILURES

_MARKER = "demo.json"
_CAMERA, _OTHER, _FROM = "d435", "kinect-v1", "0.6:0.9"
_SCANS, _LABELS = 12, 3  # a part
_WHOLE, _OWN = 200, 80  # seconds of all steps on two cores


def demo(
    out: Path = Path("demo"),
    cad: Path | None = None,
    scans: Path | None = None,
    seed: int = 0,
    workers: int | None = None,
) -> int:
    """Make a classifier of parts from their CAD, in steps that are printed as commands.

    Without scans of yours another simulated camera plays the real one, and its scans are scored:
    surfaces against scans, adaptation, a few labels, the fit of CAD.

    Args:
        out: Folder to write; run again after a stop to go on.
        cad: Folder of your CAD, a file or a folder a part; by default eight built-in parts.
        scans: Folder of your own scans of these parts: files of points, one part each, z up, in
            metres. They need no labels, and nothing is scored.
        seed: Root of all seeds.
        workers: Processes that scan; all cores by default.
    """
    from qs3 import shapes
    from qs3.cli import run
    from qs3.training.adapt import command, options

    if seed < 0:
        raise InputError(f"--seed {seed}: must not be negative")
    if scans is not None and cad is None:
        raise InputError(f"--scans {scans}: name the CAD of these parts too: --cad FOLDER")
    for folder in (cad, scans):
        if folder is not None and not folder.is_dir():
            raise InputError(f"{folder}: no such folder")
    given = {"cad": str(cad), "scans": str(scans), "seed": seed}
    if (claim_folder(out, _MARKER) / _MARKER).is_file() and read_json(out / _MARKER) != given:
        raise InputError(f"{out}: made with other options; name another folder for --out")
    write_json(out / _MARKER, given)
    begun, done, units, whole = time.monotonic(), 0.0, None, _WHOLE if scans is None else _OWN

    def do(seconds: int, why: str, *words: object) -> None:
        nonlocal done
        pace = (time.monotonic() - begun) / done if done else 1.0
        tell("", f"# {why}; all is done in about {pace * (whole - done):.0f} s", command(*words))
        try:
            run(list(map(str, words)))
        except InputError as error:
            if FAILURES not in str(error):
                raise
            tell(f"qs3: {error}")  # single scans: the others are there
        done += seconds

    if cad is None:
        cad, units = out / "cad", "mm"
        for name in shapes.PARTS:
            part = shapes.make(name, seed=seed).apply_scale(1000)
            write_bytes(cad / f"{name}.stl", bytes(part.export(file_type="stl")))
        tell(f"{cad}: CAD of eight parts, in millimetres")
    mine, labels, place = out / "mine", out / "labels.csv", scans or out / "scans"
    files, made = options(meshes=cad, units=units), options(seed=seed, workers=workers)
    if scans is None:
        do(60, f"another camera, {_OTHER}, plays yours: it is simulated too, in other light",
           "generate", "--recipe", "parts", *files,
           *options(sensor=_OTHER, distance=_FROM, scans_per_mesh=_SCANS, seed=1000 + seed,
                    workers=workers, out=out / "camera"))  # fmt: skip
        if not place.exists():
            do(2, "its scans as files", "convert", out / "camera", place, "--to", "ply")
    fit = ["--fit"] * (scans is not None)
    do(62, "CAD and these scans, of which no label is read", "adapt", cad, place, *made, *fit,
       *options(camera=_CAMERA, units=units, out=mine))  # fmt: skip
    if not labels.exists():
        do(4, "pick the scans whose labels help most", "suggest", mine / "run", place,
           *options(count=_LABELS * len(list(cad.iterdir())), out=labels))  # fmt: skip
    if scans is not None:
        tell(f"Next: fill in {labels}, then the command of adapt with --labels and another --out")
        return 0
    forest = ["train", "--model", "forest", *options(source=mine / "source", seed=seed)]
    every = ("--source-cloud", "all")
    learnt = {
        "surfaces": ("for comparison: whole surfaces", "--source-cloud", "surface"),
        "scans-only": ("for comparison: simulated scans, without adaptation", *every),
        "few": (f"{_LABELS} labels a part, from the truth that a simulation has", *files, *every,
                *options(method="qbst", target=place, labels=labels)),
    }  # fmt: skip
    labelled = _fill_in(labels)
    rows = [("learnt from", "of all", "of those without a label", "", "95 % interval")]
    for name, (why, *words) in learnt.items():
        do(6, why, *forest, *words, *options(out=out / name))
        do(4, "its answers", "predict", out / name, place, *options(csv=out / f"{name}.csv"))
    do(40, "lay the CAD onto the scans", "predict", out / "few", place, "--fit",
       *options(pictures=out / "fit", csv=out / "fit.csv"))  # fmt: skip
    do(5, "a page", "report", mine / "run", *options(data=place, source=mine / "source",
       before=out / "surfaces", out=out / "report.html"))  # fmt: skip
    answers = {"surfaces": "surfaces", "scans-only": "scans", "mine/answers": "scans, adapted"}
    answers |= {"few": f"and {len(labelled)} labels", "fit": "and the fit of CAD"}
    for name, told in answers.items():
        file, knows_labels = out / f"{name}.csv", name in ("few", "fit")
        rows.append((told, "" if knows_labels else _right(file)[0], *_right(file, labelled)))
    show("", f"Right on the scans by {_OTHER}; no real camera took part:", *columns(rows, 1),
         "The scans with a label were the least sure: the others are easier.",
         out / "report.html", out / "fit")  # fmt: skip
    return 0


def _fill_in(labels: Path) -> set[str]:
    """Write the class of each row, which is the name of its file's folder; return the files."""
    with labels.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    with labels.open("w", newline="", encoding="utf-8") as file:
        table = csv.DictWriter(file, rows[0])
        table.writeheader()
        table.writerows(row | {"class": Path(row["file"]).parent.name} for row in rows)
    return {row["file"] for row in rows}


def _right(answers: Path, labelled: Collection[str] = ()) -> tuple[str, str, str]:
    """Score the answers to scans without a label."""
    from qs3.evaluation import wilson_interval

    with answers.open(newline="", encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if row["file"] not in labelled]
    right = sum(row["class"] == Path(row["file"]).parent.name for row in rows)
    low, high = wilson_interval(right, len(rows))
    return f"{right / len(rows):.1%}", f"{right} of {len(rows)}", f"{low:.0%} to {high:.0%}"
