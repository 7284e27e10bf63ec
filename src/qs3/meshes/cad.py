"""STEP and IGES turned into triangles by OpenCASCADE (cascadio, extra ``cad``).

A process of its own does it: what makes the C++ library crash, or take all memory or time, is then
that file's fault alone.
"""

import importlib.util
import re
import subprocess
import sys
import tempfile
from pathlib import Path

from qs3.errors import InputError, MissingExtraError
from qs3.meshes.polygons import check_placed, count_placed
from qs3.reading import reading

UNITS = {".step": "meters", ".stp": "meters", ".iges": "millimeters", ".igs": "millimeters"}
"""Endings, and the unit that cascadio's triangles are in, whichever the file is in: of STEP it
writes metres, as glTF wants, of IGES OpenCASCADE's own millimetres."""

_DEFLECTION, _ANGLE = 0.005, 0.3
"""How far a chord may be from its curve, in lengths of that edge, and turn in radians."""
_SECONDS = 600
_PARTS = 100_000
_USES = re.compile(  # identifier, name and description, whole and part
    rb"NEXT_ASSEMBLY_USAGE_OCCURRENCE\s*\("
    + 3 * rb"\s*(?:(?:'[^']{0,1000}')+|\$)?\s*,"
    + rb"\s*(#\d+)\s*,\s*(#\d+)"
)
_MAPS = re.compile(
    rb"(#\d+)\s*=\s*(?:MAPPED_ITEM|REPRESENTATION_MAP|\w*REPRESENTATION)\s*\(([^;=]*);"
)


def check_extra(ending: str) -> None:
    """Refuse an ending that needs the extra ``cad`` if that is not installed."""
    if ending in UNITS and importlib.util.find_spec("cascadio") is None:
        raise MissingExtraError(f"cascadio, which reads {ending}", "cad")


def to_glb(path: Path) -> bytes:
    """Return a STEP or IGES file as GLB: an assembly's parts with their transforms, z up.

    One thread does it, so that the same file always gives the same triangles.
    """
    _check_parts(path)
    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder) / "part.glb"
        command = [sys.executable, "-P", "-m", __name__, str(path), str(out)]
        try:
            done = subprocess.run(
                command, stdin=subprocess.DEVNULL, capture_output=True, timeout=_SECONDS
            )
        except subprocess.TimeoutExpired:
            raise InputError(f"{path}: takes over {_SECONDS} s to turn into triangles") from None
        if done.returncode == 0:
            return out.read_bytes()
    lines = done.stderr.decode("utf-8", "replace").splitlines()
    reason = lines[-1] if lines and done.returncode > 0 else f"OpenCASCADE ended: {done.returncode}"
    raise InputError(f"{path}: cannot be read as {path.suffix[1:].upper()} ({reason})")


def _step_parts(step: bytes) -> list[dict[bytes, list[bytes]]]:
    """Return what assemblies place, and what representations place through mapped items."""
    below: dict[bytes, list[bytes]] = {}
    for whole, part in _USES.findall(step):
        below.setdefault(whole, []).append(part)
    shapes = {name: re.findall(rb"#\d+", text) for name, text in _MAPS.findall(step)}
    return [below, {key: [n for n in names if n in shapes] for key, names in shapes.items()}]


def _iges_parts(iges: bytes) -> list[dict[bytes, list[bytes]]]:
    """Return what subfigures (308) and their instances (408) place."""
    texts: dict[bytes, bytes] = {}
    for line in iges.splitlines():
        if line[72:73] == b"P":
            key = line[64:72].strip()
            texts[key] = texts.get(key, b"") + line[:64]
    below: dict[bytes, list[bytes]] = {}
    for key, text in texts.items():
        if name := re.match(rb"\s*308,[^,]*,(\d+)H", text):
            text = text[name.end() + int(name[1]) :]
        elif not re.match(rb"\s*408,", text):
            continue
        words = re.split(b"[,;]", text)
        below[key] = [word.strip() for word in (words[2:] if name else words[1:2])]
    return [{key: [name for name in names if name in below] for key, names in below.items()}]


def _check_parts(path: Path) -> None:
    """Refuse a file that places more parts than OpenCASCADE can copy."""
    read = _step_parts if UNITS[path.suffix.lower()] == "meters" else _iges_parts
    for links in read(path.read_bytes()):
        parts = {name for names in links.values() for name in names} | links.keys()
        own = {part: 1 for part in parts if not links.get(part)}
        check_placed(max(count_placed(links, own).values(), default=0), "parts", _PARTS)


def _convert(path: Path, out: Path) -> None:
    """Do the work; what OpenCASCADE prints is dropped."""
    # cascadio can do without, in half the time.
    sys.modules.setdefault("trimesh", None)  # pyright: ignore[reportArgumentType]
    import cascadio

    kind = "step" if UNITS[path.suffix.lower()] == "meters" else "iges"
    with reading(path):
        data = cascadio.load(
            path.read_bytes(),
            kind,
            tol_linear=_DEFLECTION,
            tol_angular=_ANGLE,
            tol_relative=True,
            use_parallel=False,
        )
    if not data:
        sys.exit("it holds no surface")
    out.write_bytes(data)


if __name__ == "__main__":
    _convert(Path(sys.argv[1]), Path(sys.argv[2]))
