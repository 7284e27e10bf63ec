"""``qs3 suggest``: uncertain scans to label, as a CSV to fill in."""

from pathlib import Path
from typing import Annotated

import tyro

from qs3.cli.text import notify, quoted, raise_last, show
from qs3.errors import InputError


def suggest(
    run: Annotated[Path, tyro.conf.Positional],
    files: Annotated[tuple[Path, ...], tyro.conf.Positional],
    count: Annotated[int, tyro.conf.arg(aliases=["-n"])] = 30,
    out: Path = Path("labels.csv"),
) -> int:
    """Pick uncertain scans to label, and write a CSV to fill in.

    They are uncertain and differ from each other; pictures beside the CSV show them, numbered as
    its rows. Fill in the column class, delete unknown rows, and train again with --labels. Scans
    that the run has learnt from are left out. A file that cannot be read is reported, and the exit
    code is 2.

    Args:
        run: Folder of a run.
        files: Files of points, z up, or folders of them.
        count: Scans to pick.
        out: New CSV with the columns number, file, suggested, confidence and class.
    """
    from qs3.answers.cloud_files import is_data_set, list_clouds
    from qs3.checks import check_numbers
    from qs3.escapes import csv_text
    from qs3.files import check_output, write_text
    from qs3.report.scans import Tile, earlier_sheets, write_sheets
    from qs3.workflow.labels import CLASS, FILE
    from qs3.workflow.suggest import suggest as pick

    if out.exists():
        raise InputError(f"--out {out}: is there already and may hold labels; name a new file")
    if out.suffix.lower() != ".csv":  # its pictures end in .png
        raise InputError(f"--out {out}: name a .csv file")
    check_numbers("--count", count)
    listed = list_clouds(files)
    if sets := [path for path in listed if is_data_set(path)]:
        raise InputError(f"{sets[0]}: is a data set; name files of points, or folders of them")
    check_output(out, "--out", ".csv")
    earlier_sheets(out.with_suffix(".png"))
    picked, faults = pick(run, listed, count)
    rows, tiles = [], []
    for number, scan in enumerate(picked, start=1):
        ((name, share),) = scan.best()
        row = {FILE: str(scan.file), "suggested": name, "confidence": f"{share:.3f}"}
        rows.append({"number": str(number), **row})
        tiles.append(Tile.of(scan, f"{number}: {name}? ({share:.2f})"))
    pages = write_sheets(out.with_suffix(".png"), tiles)
    write_text(out, csv_text(["number", FILE, "suggested", "confidence", CLASS], rows))
    show(out, *pages)
    notify(
        f"{len(picked)} of {len(listed)} scans. Fill in the column {CLASS}, then adapt or train "
        f"as before, and with --labels {quoted(out)}"
    )
    raise_last(faults, len(listed), "files")
    return 0
