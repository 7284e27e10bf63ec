"""Checked downloads and archives, and where data sets are got that no command can fetch."""

import contextlib
import http.client
import re
import stat
import urllib.error
import urllib.request
import zipfile
from pathlib import Path, PurePosixPath
from typing import Any

from tqdm import tqdm

from qs3.errors import InputError
from qs3.files import sha256
from qs3.io.whole import whole

_CHUNK = 2**20
_SMALL = 100 * 2**20

DATASETS_PAGES: dict[str, tuple[str, str]] = {
    "pointda10": (
        "https://drive.google.com/file/d/1-LfJWL5geF9h0Z2QpdTL0n4lShy8wy2J (PointDA_data.zip)",
        "modelnet/<class>/<train|test>/*.npy, shapenet/<class>/<train|test>/*.npy, scannet/*.h5",
    ),
    "modelnet10": (
        "http://3dvision.princeton.edu/projects/2014/3DShapeNets/ModelNet10.zip",
        "<class>/<train|test>/*.off",
    ),
    "modelnet": (
        "http://modelnet.cs.princeton.edu/ModelNet40.zip",
        "<class>/<train|test>/*.off; sampled: ply_data_train*.h5 and ply_data_test*.h5",
    ),
    "shapenet": (
        "https://shapenet.org (with registration)",
        "<synset>/<id>/models/model_normalized.obj",
    ),
    "scannet": (
        "http://www.scan-net.org (with a signed form)",
        "scans/<scene>/<scene>.sens, <scene>_vh_clean_2.ply and its segmentation",
    ),
    "sunrgbd": (
        "https://rgbd.cs.princeton.edu",
        "SUNRGBD/<sensor>/.../<scene>/ and SUNRGBDMeta3DBB_v2.mat",
    ),
    "specklenet10": (
        "https://github.com/Gorilla-Lab-SCUT/QS3 (SpeckleNet10 on Google Drive)",
        "raw_pc_multiview_point_at/<class>/<train|test>/*.xyz",
    ),
    "depthscannet10": (
        "https://github.com/Gorilla-Lab-SCUT/QS3 (DepthScanNet10 on Google Drive)",
        "Scannet_single_obj_1012_new/<class>/<train|test>/*.xyz",
    ),
    "scanobjectnn": (
        "https://hkust-vgd.github.io/scanobjectnn (with a form)",
        "main_split/ and main_split_nobg/ with training_objectdataset*.h5, test_objectdataset*.h5",
    ),
    "graspnetpc10": (
        "https://drive.google.com/file/d/1VVHmsSToFMVccge-LsYJW67IS94rNxWR",
        "<train|test>/<Synthetic|Real>/<kinect|realsense>/<0-9>/*.xyz",
    ),
}
"""Page and layout of each data set that has no file whose checksum we know."""


def where_to_get(name: str) -> str:
    """Return where a data set is got and what it looks like; empty where it is not known.

    Args:
        name: A data set, or a layout whose name begins with one, such as ``pointda10-scannet``.

    Example:
        >>> where_to_get("specklenet10")[:50]
        'get it from https://github.com/Gorilla-Lab-SCUT/QS'
    """
    key = re.sub(r"[\s_]+", "-", name.strip().lower())
    known = [known for known in DATASETS_PAGES if key.startswith(known)]
    if not known:
        return ""
    page, layout = DATASETS_PAGES[max(known, key=len)]
    return f"get it from {page} and unpack it; expected: {layout}"


def fetch(url: str, path: Path, checksum: str, *, timeout: float = 60.0) -> Path:
    """Download a file whose SHA-256 is known; go on where an earlier try stopped.

    The bytes go to ``<path>.part``, which gets its name only once its checksum is right. Where the
    server cannot give the rest alone, or the two parts do not make the file, it begins anew.

    Args:
        url: An http or https address.
        path: File to write; nothing is done where it is there with that checksum.
        checksum: SHA-256 of the file, hexadecimal.
        timeout: Longest silence of the server in seconds.

    Returns:
        The path.

    Raises:
        InputError: where the address cannot be reached or has no such file, the connection was
            cut, the disk is full, or the checksum is another.
    """
    path = Path(path)
    if not url.startswith(("http://", "https://")):
        raise InputError(f"{url}: not an http or https address")
    if not re.fullmatch(r"[0-9a-fA-F]{64}", checksum):
        raise InputError(f"{checksum!r}: not a SHA-256 of 64 hexadecimal digits")
    if path.exists():
        if path.is_file() and sha256(path) == checksum.lower():
            return path
        raise InputError(f"{path}: is there already and is not {url}; move it away")
    path.parent.mkdir(parents=True, exist_ok=True)
    part = path.with_name(path.name + ".part")
    resumed = part.is_file() and part.stat().st_size > 0
    _transfer(url, part, timeout)
    if resumed and sha256(part) != checksum.lower():
        part.unlink()
        _transfer(url, part, timeout)
    found = sha256(part)
    if found != checksum.lower():
        part.unlink()
        raise InputError(
            f"{url}: has the SHA-256 {found}, not {checksum.lower()}; the file there is another "
            "one or was changed on the way"
        )
    part.replace(path)
    return path


def _transfer(url: str, part: Path, timeout: float) -> None:
    """Append to ``part`` what is missing, or write it anew; all of it is there afterwards."""
    begin = part.stat().st_size if part.is_file() else 0
    try:
        answer = _open(url, begin, timeout)
        with contextlib.closing(answer):
            if begin and not _goes_on(answer, begin):
                begin = 0
            _copy(answer, part, begin, url)
    except urllib.error.HTTPError as error:
        with error:
            if error.code == 416 and begin:
                # Nothing is missing, or what is there is no part of it: the checksum will tell.
                if _total(error.headers.get("Content-Range", "")) != begin:
                    part.unlink()
                    _transfer(url, part, timeout)
                return
        raise InputError(f"{url}: the server answers {error.code} {error.reason}") from error
    except (urllib.error.URLError, http.client.HTTPException, TimeoutError, ConnectionError) as e:
        reason = getattr(e, "reason", None) or str(e) or type(e).__name__
        raise InputError(
            f"{url}: cannot be reached, or the connection was cut ({reason}); run the same command "
            "again to go on"
        ) from e
    except OSError as error:
        raise InputError(f"{part}: {error.strerror or error}") from error


def _open(url: str, begin: int, timeout: float) -> Any:
    headers = {"User-Agent": "qs3", "Accept-Encoding": "identity"}
    if begin:
        headers["Range"] = f"bytes={begin}-"
    request = urllib.request.Request(url, headers=headers)  # noqa: S310 (http and https only)
    return urllib.request.urlopen(request, timeout=timeout)  # noqa: S310


def _goes_on(answer: Any, begin: int) -> bool:
    told = answer.headers.get("Content-Range", "")
    return answer.status == 206 and told.replace(" ", "").startswith(f"bytes{begin}-")


def _total(content_range: str) -> int:
    total = content_range.rpartition("/")[2].strip()
    return int(total) if total.isdecimal() else -1


def _copy(answer: Any, part: Path, begin: int, url: str) -> None:
    length = answer.headers.get("Content-Length", "")
    expected = begin + int(length) if length.isdecimal() else None
    name = part.name.removesuffix(".part")
    with (
        part.open("ab" if begin else "wb") as file,
        tqdm(
            total=expected, initial=begin, desc=name, unit="B", unit_scale=True, disable=None
        ) as bar,
    ):
        there = begin
        while chunk := answer.read(_CHUNK):
            file.write(chunk)
            there += len(chunk)
            bar.update(len(chunk))
    if expected is not None and there < expected:
        raise InputError(
            f"{url}: the connection was cut after {there} of {expected} bytes; run the same "
            "command again to go on"
        )


def unpack(
    archive: Path, folder: Path, *, max_bytes: int = 2**40, max_ratio: float = 100.0
) -> Path:
    """Unpack a zip archive into a new or empty folder: whole or not at all.

    Every member is judged before anything is written. One that would lead outside the folder, is a
    link, is encrypted or is there twice spoils the archive.

    Args:
        archive: The zip file.
        folder: Where to.
        max_bytes: Most bytes that it may grow to.
        max_ratio: Most bytes for each byte of the archive, beyond the first 100 MiB.

    Returns:
        The folder.

    Raises:
        InputError: where the archive is damaged, would write outside, or would grow too large; or
            where the folder holds something.
    """
    archive = Path(archive)
    if not archive.is_file():
        raise InputError(f"{archive}: no such file")
    try:
        with zipfile.ZipFile(archive) as opened:
            members = opened.infolist()
            _check_names(archive, members)
            _check_sizes(archive, members, max_bytes, max_ratio)
            with whole(folder) as temporary:
                temporary.mkdir()
                for member in tqdm(members, "unpack", unit="file", disable=None):
                    _extract(opened, member, temporary)
    except InputError:
        raise
    except Exception as error:  # zipfile raises whatever it stumbles over in damaged files
        lines = str(error).splitlines() or [type(error).__name__]
        raise InputError(
            f"{archive}: cannot be unpacked: not a zip archive, or damaged ({lines[0]})"
        ) from error
    return Path(folder)


def _check_names(archive: Path, members: list[zipfile.ZipInfo]) -> None:
    files: set[str] = set()
    folders: set[str] = set()
    for member in members:
        # orig_filename: zipfile itself cuts the other one at a NUL.
        name = member.orig_filename.replace("\\", "/")
        parts = PurePosixPath(name).parts
        outside = not parts or name.startswith("/") or ".." in parts or "\0" in name
        if outside or re.match(r"[A-Za-z]:", name):
            raise InputError(f"{archive}: member {name[:80]!r} would lead outside the folder")
        kind = stat.S_IFMT(member.external_attr >> 16)
        if kind not in (0, stat.S_IFREG, stat.S_IFDIR):
            raise InputError(f"{archive}: member {name[:80]!r} is a link or no plain file")
        if member.flag_bits & 1:
            raise InputError(f"{archive}: member {name[:80]!r} is encrypted")
        folded = "/".join(parts).casefold()
        above = folded.split("/")
        folders.update("/".join(above[:depth]) for depth in range(1, len(above)))
        if name.endswith("/"):
            folders.add(folded)
        elif folded in files:
            raise InputError(f"{archive}: member {name[:80]!r} is there twice")
        else:
            files.add(folded)
    if both := files & folders:
        raise InputError(f"{archive}: {min(both)[:80]!r} is both a file and a folder")


def _check_sizes(
    archive: Path, members: list[zipfile.ZipInfo], max_bytes: int, max_ratio: float
) -> None:
    announced = sum(member.file_size for member in members)
    size = archive.stat().st_size
    if announced > max_bytes:
        raise InputError(
            f"{archive}: would grow to {announced} bytes, over the {max_bytes} allowed"
        )
    if announced > _SMALL + max_ratio * size:
        raise InputError(
            f"{archive}: {size} bytes would grow to {announced}, as no honest data set does"
        )


def _extract(opened: zipfile.ZipFile, member: zipfile.ZipInfo, folder: Path) -> None:
    path = folder / PurePosixPath(member.filename.replace("\\", "/"))
    if member.is_dir():
        path.mkdir(parents=True, exist_ok=True)
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    # zipfile hands out no more than the announced bytes, and checks the sum at their end.
    with opened.open(member) as source, path.open("wb") as file:
        while chunk := source.read(_CHUNK):
            file.write(chunk)
