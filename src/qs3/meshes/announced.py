"""What keeps a small file from filling the memory: announced sizes, and a limit while reading."""

import contextlib
import functools
import struct
import threading
import zipfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from qs3.errors import InputError
from qs3.files import parse_json

_BYTES = {5120: 1, 5121: 1, 5122: 2, 5123: 2, 5125: 4, 5126: 4}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4, "MAT2": 4, "MAT3": 9, "MAT4": 16}
_MOST_BYTES, _MOST_BYTES_SHARE = 1 << 26, 16
_MOST_PLACED = 1 << 22
_MOST_PARTS = 1 << 14
_READING, _READING_SHARE = 2 << 30, 32

_limited = threading.Lock()


def check_gltf(path: Path) -> None:
    """Refuse a GLB or glTF file that announces far more than it and the files beside it hold.

    By the specification an accessor without a buffer is zeros, of any number, and any number of
    nodes may place one mesh; readers allocate what is announced.

    Raises:
        InputError: where it does, or its JSON is damaged.
    """
    with path.open("rb") as handle:
        head = handle.read(20)
        if head[:4] == b"glTF" and len(head) == 20:
            text = handle.read(struct.unpack_from("<I", head, 12)[0])
        else:
            text = head + handle.read()
    tree = parse_json(text, path)
    try:
        files = [path.parent / str(buffer.get("uri", "")) for buffer in tree.get("buffers", [])]
        size = sum(file.stat().st_size for file in {path, *files} if _is_file(file))
        sizes = [_count(accessor["count"]) for accessor in tree.get("accessors", [])]
        announced = sum(
            count * _BYTES[accessor["componentType"]] * _WIDTHS[accessor["type"]]
            for count, accessor in zip(sizes, tree.get("accessors", []), strict=True)
        )
        meshes = [
            sum(sizes[_count(index)] for index in _accessors(mesh))
            for mesh in tree.get("meshes", [])
        ]
        nodes = [_count(node["mesh"]) for node in tree.get("nodes", []) if "mesh" in node]
        placed = sum(meshes) + sum(meshes[index] for index in nodes)
    except (AttributeError, IndexError, KeyError, TypeError, ValueError) as error:
        raise InputError(f"{path}: damaged ({type(error).__name__}: {error})") from error
    if announced > _MOST_BYTES + _MOST_BYTES_SHARE * size:
        raise InputError(f"{path}: announces {announced} bytes of numbers, and holds {size} bytes")
    if placed > _MOST_PLACED + size:
        raise InputError(
            f"{path}: {len(nodes)} instances of its meshes come to {placed} vertices and corners; "
            "split or simplify it"
        )


def check_3mf(path: Path) -> None:
    """Refuse a 3MF that unpacks to far more than it holds, or places its parts too often.

    Its components may hold one another: a hundred of them can be 10¹⁰ parts.

    Raises:
        InputError: where it does, or it is damaged.
    """
    from lxml import etree  # pyright: ignore[reportAttributeAccessIssue]
    from trimesh.exchange.common import XML_PARSER_OPTIONS

    inside: dict[str, list[str]] = {}
    placed: list[str] = []

    @functools.cache
    def count(name: str) -> int:
        return 1 + sum(count(part) for part in inside.get(name, ()))

    try:
        with zipfile.ZipFile(path) as archive:
            announced = sum(member.file_size for member in archive.infolist())
            size = path.stat().st_size
            if announced > _MOST_BYTES + _MOST_BYTES_SHARE * size:
                raise InputError(f"{path}: would unpack to {announced} bytes, and holds {size}")
            names = [name for name in archive.namelist() if "3d/3dmodel.model" in name.lower()]
            with archive.open(names[0]) as model:
                tags = [f"{{*}}{tag}" for tag in ("vertices", "triangles", "object", "item")]
                for _, element in etree.iterparse(model, tag=tags, **XML_PARSER_OPTIONS):
                    kind = etree.QName(element).localname
                    if kind == "item":
                        placed.append(element.attrib["objectid"])
                    elif kind == "object":
                        parts = element.iter("{*}component")
                        inside[element.attrib["id"]] = [part.attrib["objectid"] for part in parts]
                    else:
                        element.clear()
        parts = sum(map(count, placed))
    except RecursionError:
        raise InputError(f"{path}: its components hold one another in a circle") from None
    except (zipfile.BadZipFile, NotImplementedError, RuntimeError, EOFError) as error:
        raise InputError(f"{path}: not a 3MF file ({error})") from error
    except (LookupError, etree.XMLSyntaxError) as error:
        raise InputError(f"{path}: damaged ({type(error).__name__}: {error})") from error
    if parts > _MOST_PARTS:
        raise InputError(f"{path}: places {parts} parts; split or simplify it")


def _accessors(mesh: dict[str, Any]) -> list[int]:
    """The positions and corners of all primitives of a mesh."""
    primitives = mesh.get("primitives", [])
    corners = [primitive["indices"] for primitive in primitives if "indices" in primitive]
    places = [primitive.get("attributes", {}).get("POSITION") for primitive in primitives]
    return corners + [place for place in places if place is not None]


def _count(value: Any) -> int:
    if type(value) is not int or value < 0:
        raise ValueError(f"{str(value)[:40]} is no count")
    return value


def _is_file(path: Path) -> bool:
    try:
        return path.is_file()
    except (OSError, ValueError):  # a name that no file can have
        return False


@contextlib.contextmanager
def memory_limit(path: Path) -> Iterator[None]:
    """Let this process take 2 GiB more, and 32 times a file's size, while it reads the file.

    Linux alone can tell what a process has by now; elsewhere there is no limit.

    Raises:
        InputError: where it would take more.
    """
    try:
        import resource

        pages = int(Path("/proc/self/statm").read_text().split()[0])
    except (ImportError, OSError):
        yield
        return
    most = _READING + _READING_SHARE * path.stat().st_size
    with _limited:  # the limit is the whole process's
        before = lower_limit(resource.RLIMIT_AS, pages * resource.getpagesize() + most)
        try:
            yield
        except MemoryError as error:
            raise InputError(
                f"{path}: takes over {most / 2**30:.1f} GiB of memory to read; simplify the mesh"
            ) from error
        finally:
            resource.setrlimit(resource.RLIMIT_AS, before)


def lower_limit(kind: int, most: int) -> tuple[int, int]:
    """Bring a limit of this process down to ``most``, and return what it was; a lower one stays."""
    import resource

    before = resource.getrlimit(kind)
    least = min(limit for limit in (most, *before) if limit != resource.RLIM_INFINITY)
    resource.setrlimit(kind, (least, before[1]))
    return before
