"""Tables of answers that an earlier call wrote, and those of others, which are never replaced."""

import re
from pathlib import Path

from qs3.errors import InputError
from qs3.files import check_output, read_json

_HEADS = {
    "csv": re.compile(rb"(file,class,(confidence|cad)|frame,class,cad),(.*,)?fault"),
    "bop": re.compile(rb"scene_id,im_id,obj_id,score,R,t,time"),
}
"""Headings of the tables of answers, by kind."""
_ANSWERS = {"probabilities", "candidates", "parts", "fault"}
"""One of these is in each entry of a JSON of answers."""


def check_table(file: Path, kind: str, option: str) -> None:
    """Refuse a table of a kind (csv, json, bop) that cannot be written or holds something else.

    ``option`` is the one that named it.
    """
    check_output(file, option, ".json" if kind == "json" else ".csv")
    if file.is_file() and file.stat().st_size and not _holds_answers(file, kind):
        raise InputError(
            f"{option} {file}: is there already and holds no answers, but maybe labels, a camera "
            "or a run; move it elsewhere, or name another "
            f"{option}"
        )


def _holds_answers(file: Path, kind: str) -> bool:
    """Return whether an earlier call wrote a file of a kind."""
    if kind != "json":
        with file.open("rb") as handle:
            line = handle.readline(1 << 16).removeprefix(b"\xef\xbb\xbf").strip()
        line = line.replace(b'"', b"").replace(b";", b",")  # a spreadsheet may have saved it
        return _HEADS[kind].fullmatch(line) is not None
    try:
        rows = read_json(file)
    except InputError:  # no JSON, so it is not ours
        return False
    return isinstance(rows, list) and all(
        isinstance(row, dict) and "file" in row and _ANSWERS & row.keys() for row in rows
    )
