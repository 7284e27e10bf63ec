"""``qs3 demo``: the way for own parts, with built-in ones and a simulated camera."""

import contextlib
import csv
import io
import time
from collections.abc import Collection
from pathlib import Path

from qs3.cli.text import columns, notify, show
from qs3.errors import FailedScansError, InputError
from qs3.files import claim_folder, read_json, write_bytes, write_json, write_text

_MARKER = "demo.json"
_CAMERA, _OTHER, _FROM = "d435", "kinect-v1", "0.6:0.9"
_SCANS, _LABELS = 12, 3  # a part
_WHOLE = 225  # seconds of all steps on two cores


def demo(out: Path = Path("demo"), seed: int = 0, workers: int | None = None) -> int:
    """Make a classifier of parts from their CAD, in steps that are printed as commands.

    Another simulated camera plays the real one, and the answers to its scans are scored: of a
    forest of CAD surfaces, of the CAD alone, of a forest of simulated scans, of forest and CAD
    together, and with a few labels. With your own parts: qs3 adapt.

    Args:
        out: Folder to write; run again after a stop to go on.
        seed: Root of all seeds.
        workers: Processes that scan; all cores by default.
    """
    from qs3 import shapes
    from qs3.checks import check_numbers
    from qs3.cli import run
    from qs3.workflow.options import command, options

    check_numbers("--seed", seed, 0)
    marker, facts = claim_folder(out, _MARKER) / _MARKER, {"seed": seed}
    if marker.is_file() and read_json(marker) != facts:
        raise InputError(f"{out}: made with another seed; name another folder for --out")
    write_json(marker, facts)
    begun, done = time.monotonic(), 0.0

    def do(seconds: int, why: str, *words: object) -> None:
        nonlocal done
        pace = (time.monotonic() - begun) / done if done else 1.0
        notify("", f"# {why}; all is done in about {pace * (_WHOLE - done):.0f} s", command(*words))
        # A line per scan would hide the steps; the tables have them.
        is_long = words[0] in ("predict", "locate")
        try:
            with contextlib.redirect_stdout(io.StringIO()) if is_long else contextlib.nullcontext():
                run(list(map(str, words)))
        except FailedScansError as error:
            notify(f"qs3: {error}")  # single scans: the others are there
        done += seconds

    cad, mine, scans, labels = out / "cad", out / "mine", out / "scans", out / "labels.csv"
    for name in shapes.PARTS:
        part = shapes.make(name, seed=seed).apply_scale(1000)
        write_bytes(cad / f"{name}.stl", bytes(part.export(file_type="stl")))
    notify(f"{cad}: CAD of {len(shapes.PARTS)} parts, in millimetres")
    files, seeded = options(meshes=cad, units="mm"), options(seed=seed, workers=workers)
    do(60, f"another camera, {_OTHER}, plays yours: it is simulated too, in other light",
       "generate", "--recipe", "parts", *files,
       *options(sensor=_OTHER, distance=_FROM, table_cut=(0, 0), scans_per_mesh=_SCANS,
                seed=1000 + seed, workers=workers, out=out / "camera"))  # fmt: skip
    if not scans.exists():
        do(2, "its scans as files", "convert", out / "camera", scans, "--to", "ply")
    do(62, "CAD and these scans, of which no label is read", "adapt", cad, scans, *seeded,
       *options(camera=_CAMERA, units="mm", out=mine))  # fmt: skip
    do(25, "for comparison: the CAD alone, rendered and compared, without training", "locate", cad,
       scans, *options(units="mm", csv=out / "locate.csv"))  # fmt: skip
    if not labels.exists():
        do(4, "pick uncertain scans to label", "suggest", mine / "run", scans,
           *options(count=_LABELS * len(shapes.PARTS), out=labels))  # fmt: skip
    forest = ["train", "--model", "forest", *options(source=mine / "source", seed=seed)]
    labelled = _fill_in(labels)
    do(6, "for comparison: a forest of whole surfaces", *forest, "--source-cloud", "surface",
       *options(out=out / "surfaces"))  # fmt: skip
    do(4, "its answers", "predict", out / "surfaces", scans, *options(csv=out / "surfaces.csv"))
    do(4, "for comparison: the forest of scans alone, no CAD is compared", "predict", mine / "run",
       scans, "--no-pose", *options(csv=out / "forest.csv"))  # fmt: skip
    do(20, f"{_LABELS} labels per part, from the truth that a simulation has", *forest, *files,
       "--source-cloud", "all", *options(target=scans, labels=labels, out=out / "few"))  # fmt: skip
    do(20, "its answers, and the CAD over the scans, the doubtful first", "predict", out / "few",
       scans, *options(csv=out / "few.csv", pictures=out / "poses"))  # fmt: skip
    do(5, "a page", "report", mine / "run", *options(data=scans, source=mine / "source",
       before=out / "surfaces", out=out / "report.html"))  # fmt: skip
    rows = [("answered by", "of all", "of those without a label", "", "95 % interval")]
    answers = {
        "surfaces": "forest of surfaces",
        "locate": "CAD alone, rendered and compared",
        "forest": "forest of simulated scans",
        "mine/answers": "forest and CAD",
        "few": f"forest, CAD and {len(labelled)} labels",
    }
    for name, text in answers.items():
        file = out / f"{name}.csv"
        rows.append((text, "" if name == "few" else _right(file)[0], *_right(file, labelled)))
    show("", f"Right on the scans by {_OTHER}; no real camera took part:", *columns(rows, 1),
         "The scans with a label were the least sure: the others are easier.",
         mine / "parts.html", out / "report.html", out / "poses")  # fmt: skip
    return 0


def _fill_in(labels: Path) -> set[str]:
    """Write the class of each row, which is the name of its file's folder; return the files."""
    with labels.open(newline="", encoding="utf-8") as file:
        rows = list(csv.DictReader(file))
    filled = io.StringIO(newline="")
    table = csv.DictWriter(filled, rows[0])
    table.writeheader()
    table.writerows(row | {"class": Path(row["file"]).parent.name} for row in rows)
    write_text(labels, filled.getvalue())  # whole: a stop in between would lose the rows
    return {row["file"] for row in rows}


def _right(answers: Path, labelled: Collection[str] = ()) -> tuple[str, str, str]:
    """Score the answers to scans without a label."""
    from qs3.evaluation import wilson_interval

    with answers.open(newline="", encoding="utf-8") as file:
        rows = [row for row in csv.DictReader(file) if row["file"] not in labelled]
    right = sum(row["class"] == Path(row["file"]).parent.name for row in rows)
    low, high = wilson_interval(right, len(rows))
    return f"{right / len(rows):.1%}", f"{right} of {len(rows)}", f"{low:.0%} to {high:.0%}"
