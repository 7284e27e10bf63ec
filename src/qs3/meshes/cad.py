"""STEP and IGES turned into triangles by OpenCASCADE (cascadio, extra ``cad``).

A process of its own does it: what makes the C++ library crash, or take all memory or time, is then
that file's fault alone.
"""

import importlib.util
import subprocess
import sys
import tempfile
from pathlib import Path

from qs3.errors import InputError, MissingExtraError, first_few, say_once
from qs3.meshes.cad_text import UNITS, check_iges, has_length_unit, longest_side, prepare
from qs3.reading import limit_memory, plain_text, reading

_DEFLECTION, _ANGLE = 0.005, 0.3
"""Largest distance of a chord from its curve, in lengths of that edge, and turn in radians."""
_SECONDS, _PER_BYTE = 300, 20e-6
"""Time that a file may take, and more of it for each byte."""
_SHORTEST = 1e-5
"""Metres: OpenCASCADE bends smaller shapes, or halves their triangles without end."""


def check_extra(ending: str) -> None:
    """Refuse an ending that needs the extra ``cad`` if it is missing."""
    if ending in UNITS and importlib.util.find_spec("cascadio") is None:
        raise MissingExtraError(f"cascadio, which reads {ending}", "cad")


def check_length(metres: float) -> None:
    """Refuse a STEP or IGES file whose longest side is too short for OpenCASCADE."""
    if metres < _SHORTEST:
        raise InputError(
            f"is under {metres:.2g} m long, and no side under {_SHORTEST:g} m is read; "
            "export it in its unit"
        )


def to_glb(path: Path) -> bytes:
    """Return a STEP or IGES file as GLB: an assembly's parts with their transforms, z up.

    One thread does it, so that the same file always gives the same triangles. A shape that is both
    exact and tessellated comes once.
    """
    seconds = _SECONDS + _PER_BYTE * path.stat().st_size
    data, elsewhere, notes = plain_text(path.read_bytes()), [], []
    if UNITS[path.suffix.lower()] == "meters":
        data, elsewhere, lost = prepare(data)
        elsewhere = [name for name in elsewhere if name != path.name]
        check_length(longest_side(data))
        if not has_length_unit(data):
            notes.append("names no unit of length, and is taken for millimetres")
        if lost:
            notes.append(f"parts have no place and are left out ({first_few(lost)}): export again")
    else:
        check_iges(data)
    parts = f"parts lie in other files ({first_few(elsewhere)}); export the assembly as one file"
    with tempfile.TemporaryDirectory() as folder:
        prepared, out = Path(folder) / f"part{path.suffix.lower()}", Path(folder) / "part.glb"
        prepared.write_bytes(data)
        command = [sys.executable, "-P", "-m", __name__, str(prepared), str(out)]
        try:
            done = subprocess.run(
                command, stdin=subprocess.DEVNULL, capture_output=True, timeout=seconds
            )
        except subprocess.TimeoutExpired:
            raise InputError(
                f"{path}: takes over {seconds:.0f} s to turn into triangles; simplify or split it"
            ) from None
        if done.returncode == 0:
            for note in (*notes, *[parts] * bool(elsewhere)):
                say_once(f"{path}: {note}")
            return out.read_bytes()
    if elsewhere and done.returncode > 0:
        raise InputError(f"{path}: holds no surface: its {parts}")
    lines = done.stderr.decode("utf-8", "replace").splitlines()
    reason = lines[-1] if lines and done.returncode > 0 else f"OpenCASCADE ended: {done.returncode}"
    reason = reason.rpartition(f"{prepared}: ")[2]
    is_step = UNITS[path.suffix.lower()] == "meters"
    if done.returncode > 0 and is_step and b"END-ISO-10303-21" not in data:
        reason = "it has no END-ISO-10303-21; the file is cut short"
    fault = f"cannot be read as {path.suffix[1:].upper()} ({reason}); mend or export it again"
    raise InputError(f"{path}: {fault}")


def _convert(path: Path, out: Path) -> None:
    # cascadio can do without, in half the time.
    sys.modules.setdefault("trimesh", None)  # pyright: ignore[reportArgumentType]
    import cascadio

    kind = "step" if UNITS[path.suffix.lower()] == "meters" else "iges"
    limit_memory(path)
    with reading(path):
        data = cascadio.load(
            path.read_bytes(),
            kind,
            tol_linear=_DEFLECTION,
            tol_angular=_ANGLE,
            tol_relative=True,
            use_parallel=False,
            include_brep=True,
        )
    if not data:
        sys.exit("it holds no surface")
    out.write_bytes(data)


if __name__ == "__main__":
    _convert(Path(sys.argv[1]), Path(sys.argv[2]))
