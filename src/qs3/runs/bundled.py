"""Bundled networks: their names stand for folders of runs."""

from pathlib import Path

from qs3.errors import InputError

WEIGHTS = Path(__file__).parents[1] / "weights"
"""A folder for each bundled network, made by ``benchmarks/ship.py`` and read-only."""


def shipped() -> list[str]:
    """Return the names of the bundled networks."""
    return sorted(place.parent.name for place in WEIGHTS.glob("*/model.safetensors"))


def find_run(run: str | Path) -> Path:
    """Return a path as it is; if nothing is there, a name of `shipped` becomes its folder."""
    path = Path(run)
    return path if path.exists() or str(path) not in shipped() else WEIGHTS / path


def workplace(run: str | Path) -> Path:
    """Return the folder for files made from a run: its own.

    Raises:
        InputError: if the run is a network that comes with qs3, whose folder is not the user's.
    """
    path = find_run(run)
    path = path.parent if path.is_file() else path
    if path.is_relative_to(WEIGHTS):
        raise InputError(f"{run}: comes with qs3 and has no folder of yours; name the file: --out")
    return path


def not_a_run(folder: Path) -> str:
    """Return an error for a path that is no run; it names the run inside, as of qs3 adapt."""
    inside = sorted(path.parent for path in folder.glob("*/run.json"))
    if inside:
        return f"not a run of qs3; did you mean {' or '.join(map(str, inside[:3]))}?"
    names = ", ".join(shipped())
    return f"not a run of qs3; networks that come with it, where no file has their name: {names}"
