"""Files of another kind than their ending says, under every ending of meshes and clouds."""

import bz2
import gzip
import importlib.util
import io
import lzma
import tarfile
import zipfile
from pathlib import Path

import numpy as np
import pytest

from qs3.clouds.files import POINT_FILES, read_cloud
from qs3.clouds.load import read_clouds
from qs3.meshes import load_mesh
from qs3.meshes.cad_text import UNITS
from qs3.meshes.loading import EXTENSIONS

from .hostile import refused

STL = "solid a\nfacet normal 0 0 1\nouter loop\nvertex 0 0 0\nvertex 1 0 0\nvertex 0 1 0\n"
STL += "endloop\nendfacet\nendsolid a\n"
OBJ = b"v 0 0 0\nv 1 0 0\nv 0 1 0\nf 1 2 3\n"


def zipped(name: str = "part.obj") -> bytes:
    buffer = io.BytesIO()
    with zipfile.ZipFile(buffer, "w") as archive:
        archive.writestr(name, OBJ)
    return buffer.getvalue()


def tarred() -> bytes:
    buffer = io.BytesIO()
    with tarfile.open(fileobj=buffer, mode="w") as archive:
        member = tarfile.TarInfo("part.obj")
        member.size = len(OBJ)
        archive.addfile(member, io.BytesIO(OBJ))
    return buffer.getvalue()


CONTENTS = {
    "lfs": (b"version https://git-lfs.github.com/spec/v1\noid sha256:a\nsize 9\n", "Git LFS"),
    "annex": (b"../../.git/annex/objects/k7/Z/MD5E-s9--a.stl/MD5E-s9--a.stl\n", "git-annex"),
    "page": (b"\n\n<!DOCTYPE html>\n<html><body>404: Not Found</body></html>\n", "a web page"),
    "commented page": (b"<!-- a --><!-- b -->\n<HTML lang='en'><head>", "a web page"),
    "zip": (zipped(), "a zip archive; unpack it"),
    "gzip": (gzip.compress(OBJ), "gzip; unpack it"),
    "bzip2": (bz2.compress(OBJ), "bzip2; unpack it"),
    "xz": (lzma.compress(OBJ), "xz; unpack it"),
    "tar": (tarred(), "a tar archive"),
    "pdf": (b"%PDF-1.7\n", "a PDF"),
    "png": (b"\x89PNG\r\n\x1a\n" + bytes(99), "a PNG image"),
    "error": (b'{"message": "Not Found"}', "JSON"),
    "native": (b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1" + bytes(600), "native CAD"),
    "stl": (STL.encode(), "an STL file; name it .stl"),
    "step": (b"ISO-10303-21;\nHEADER;\nENDSEC;\n", "a STEP file; name it .step"),
    "ply": (b"ply\nformat ascii 1.0\ncomment a\n", "a PLY file; name it .ply"),
}
OWN = {"stl": (".stl",), "ply": (".ply",), "zip": (".3mf", ".npz"), "error": (".gltf",)}
OWN["step"] = (".step", ".stp")
TEXT = (".txt", ".xyz", ".csv", ".asc", ".pts")


def names(kind: str, endings: tuple[str, ...]) -> list[str]:
    return [ending for ending in endings if ending not in OWN.get(kind, ())]


@pytest.mark.parametrize("kind", CONTENTS)
def test_a_mesh_of_another_kind_is_called_what_it_is(tmp_path: Path, kind: str) -> None:
    content, message = CONTENTS[kind]
    cad = importlib.util.find_spec("cascadio") is not None and kind in ("lfs", "page", "zip")
    for ending in names(kind, EXTENSIONS):
        if ending in UNITS and not cad:
            continue
        path = tmp_path / f"a{ending}"
        path.write_bytes(content)
        with refused(f"cannot be read as {ending[1:].upper()}: it is .*{message}", path):
            load_mesh(path)


@pytest.mark.parametrize("kind", CONTENTS)
def test_a_cloud_of_another_kind_is_called_what_it_is(tmp_path: Path, kind: str) -> None:
    content, message = CONTENTS[kind]
    for ending in names(kind, (*POINT_FILES, *TEXT, ".npz")):
        path = tmp_path / f"a{ending}"
        path.write_bytes(content)
        with refused(f"cannot be read as {ending[1:].upper()}: it is .*{message}", path):
            read_cloud(path)
    for name in names(kind, ("ply_data_train0.h5", "clouds.npz")):
        path = tmp_path / name
        path.write_bytes(content)
        if Path(name).suffix in OWN.get(kind, ()):
            continue
        with refused(f"it is .*{message}", path):
            read_clouds(path)


def test_a_file_of_its_own_kind_keeps_its_own_fault(tmp_path: Path) -> None:
    path = tmp_path / "a.3mf"
    path.write_bytes(zipped())
    with refused(r"names the part .*, which it does not hold", path):
        load_mesh(path)
    path = tmp_path / "a.stl"
    path.write_text(STL.partition("endfacet")[0])
    with refused("line 2: no facet of three vertices", path):
        load_mesh(path)
    path = tmp_path / "a.txt"
    np.savetxt(path, np.eye(3))
    assert read_cloud(path).tolist() == np.eye(3).tolist()
