"""Networks that come with qs3: their names stand for folders of runs."""

from pathlib import Path

WEIGHTS = Path(__file__).parents[1] / "weights"
"""A folder for each network, as ``benchmarks/ship.py`` makes it; nothing is ever written there."""


def shipped() -> list[str]:
    """Return the names of the networks that come with qs3."""
    return sorted(place.parent.name for place in WEIGHTS.glob("*/model.safetensors"))


def find_run(run: str | Path) -> Path:
    """Return a path as it is; if nothing is there, a name of `shipped` becomes its folder.

    Example:
        >>> find_run("runs/mine").as_posix()
        'runs/mine'
    """
    path = Path(run)
    return path if path.exists() or str(path) not in shipped() else WEIGHTS / path


def workplace(run: str | Path) -> Path:
    """Return where files go that are made from a run: its folder, of a file the one it lies in.

    What is made from a network that comes with qs3 goes into the working directory.
    """
    path = find_run(run)
    path = path.parent if path.is_file() else path
    return Path() if path.is_relative_to(WEIGHTS) else path


def not_a_run() -> str:
    """Say that a path is no run, and what there is besides."""
    names = ", ".join(shipped())
    return f"not a run of qs3; networks that come with it, where no file has their name: {names}"
