"""Options of the way for own parts, and the words of the commands that repeat its steps."""

import shlex
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Literal

from qs3.checks import Bounds, Seed, check, check_tolerance
from qs3.escapes import path_word
from qs3.meshes.sizes import Unit

Method = Literal["qbst", "spst", "source-only"]


class Written(StrEnum):
    """Files and folders of the results of ``qs3 adapt``."""

    ANSWERS = "answers.csv"
    POSES = "poses.json"
    PARTS_PAGE = "parts.html"
    PAGE = "report.html"
    SHEET = "contact-sheet.png"
    CAD = "cad"
    PICTURES = "poses"
    RUN = "run"
    LABELLED_RUN = "run-labelled"
    SOURCE = "source"


@dataclass(frozen=True, kw_only=True)
class AdaptOptions:
    """Options of ``qs3 adapt`` and `qs3.adapt`."""

    camera: str = "d435"
    """Preset of the camera (qs3 sensors), or a TOML file of your own."""
    units: Unit | None = None
    """Unit of the mesh files; default: the file's, else m up to a longest side of 5, mm above."""
    up: Literal["z", "y"] | None = None
    """Up axis of every mesh file; default: y for glTF, z for all others."""
    labels: Path | None = None
    """CSV of a few labelled scans, columns file and class (qs3 suggest writes one). The run, named
    few-label, lies beside the other one, and learns from the same simulated scans."""
    like: bool = True
    """Scan with as many points as your scans have, and from where your camera stood, if the scans
    record it, as those of qs3 segment do. The measures are printed."""
    distance: tuple[float, float] | None = None
    """Distance from the camera to a part, metres; default: as measured, else as usual for parts, in
    the camera's own range."""
    elevation: tuple[float, float] | None = None
    """Elevation of the camera above the horizontal, degrees; default: as measured, else as usual
    for parts."""
    method: Method = "source-only"
    """Rounds of self-training on the scans, or none: with the CAD compared, they gained nothing."""
    unknown: Annotated[float | None, Bounds(high=1)] = None
    """Share of known objects that may be rejected as "unknown", as in qs3 predict."""
    tolerance: float = 0.0
    """Share by which parts may be larger or smaller than their CAD, such as 0.1: one scale per
    class, found over all of its scans (three at least), printed and kept for qs3 predict."""
    force: bool = False
    """Go on although sizes of CAD and scans disagree, or two classes have the same CAD."""
    workers: Annotated[int | None, Bounds()] = None
    """Processes that scan; default: all cores. 0 scans in this one."""
    seed: Seed = 0
    """Root of all random steps."""

    def __post_init__(self) -> None:
        check(self, "adapt")
        check_tolerance(self.tolerance)


def options(**values: object) -> list[str]:
    """Return words of a command line; those of None and False are left out.

    Example:
        >>> options(scans_per_mesh=5, up=None, on_table=True, elevation=(-5, 0.5), out="-x")
        ['--scans-per-mesh', '5', '--on-table', '--elevation=-5:0.5', '--out=-x']
    """
    words = []
    for name, value in values.items():
        if value is None or value is False:
            continue
        words.append(f"--{name.replace('_', '-')}")
        if value is True:
            continue
        is_range = isinstance(value, tuple)
        text = ":".join(f"{end:g}" for end in value) if is_range else str(value)
        if text.startswith("-"):  # alone it would be an option
            words[-1] += f"={text}"
        else:
            words.append(text)
    return words


def to_files(data: Path) -> str:
    """Return the command that writes a file of each cloud of a data set."""
    return command("convert", data, "FOLDER", "--to", "ply")


def command(*words: object) -> str:
    """Return a command of qs3 as a shell takes it."""
    texts = [path_word(word) if isinstance(word, Path) else str(word) for word in words]
    return f"qs3 {shlex.join(texts)}"
