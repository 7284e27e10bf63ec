"""A folder to write a data set into: on a disk of this machine, or any address fsspec knows."""

import contextlib
import functools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from qs3.errors import InputError, MissingExtraError
from qs3.files import claim_folder, folder_lock, remove_left_overs, write_bytes

PARTS = ".parts"
"""Sub-folder of what is on its way into a data set."""

_EXTRAS = {
    "s3": ("s3fs", "s3"),
    "s3a": ("s3fs", "s3"),
    "gs": ("gcsfs", "gs"),
    "gcs": ("gcsfs", "gs"),
}


@dataclass(frozen=True)
class Folder:
    """A folder by its path or address; nothing is made or looked at before it is asked for.

    A file appears whole or not at all: on a disk under a temporary name, synced and then renamed;
    in an object store by one PUT under its final name.
    """

    address: str
    """Path on this machine, or an address such as ``s3://bucket/folder``."""

    def __str__(self) -> str:
        """Return the path or address."""
        return self.address

    @property
    def path(self) -> Path | None:
        """Where it is on a disk of this machine; None in an object store."""
        return None if "://" in self.address else Path(self.address)

    @property
    def name(self) -> str:
        """Last part of the path or address."""
        path = self.path
        return PurePosixPath(self.address).name if path is None else path.resolve().name

    @property
    def present(self) -> bool:
        """Whether the folder is there; in an object store, whether anything is in it."""
        return bool(self.names()) if self.path is None else self.path.is_dir()

    def exists(self, name: str) -> bool:
        """Whether there is a file of this name."""
        return bool(self._fs.isfile(self._at(name)))

    def read(self, name: str) -> bytes:
        """Return a file's bytes.

        Raises:
            InputError: where there is no such file.
        """
        try:
            return self._fs.cat_file(self._at(name))
        except FileNotFoundError:
            raise InputError(f"{self.address.rstrip('/')}/{name}: no such file") from None

    def read_many(self, names: Sequence[str]) -> dict[str, bytes]:
        """Return the bytes of several files by their names, fetched side by side."""
        paths = [self._at(name) for name in names]
        contents = self._fs.cat_ranges(paths, None, None, on_error="raise") if paths else []
        return dict(zip(names, contents, strict=True))

    def write(self, name: str, data: bytes) -> None:
        """Write a file, whole or not at all."""
        if self.path is None:
            self._fs.pipe_file(self._at(name), data)
        else:
            write_bytes(self.path / name, data)

    def names(self, below: str = "") -> list[str]:
        """Return the files below a sub-folder, with its name before theirs, in order."""
        root = self._at("")
        try:
            paths = self._fs.find(self._at(below))
        except FileNotFoundError:
            return []
        return sorted(path[path.index(root) + len(root) + 1 :] for path in paths)

    def remove(self, name: str) -> None:
        """Remove a file or a sub-folder, if it is there."""
        with contextlib.suppress(FileNotFoundError):
            self._fs.rm(self._at(name), recursive=True)

    def size(self, name: str) -> int:
        """Bytes of a file."""
        return int(self._fs.size(self._at(name)))

    def claim(self, marker: str) -> None:
        """Make the folder; refuse one that holds something else than ours, told by ``marker``.

        Raises:
            InputError: where it does.
        """
        if self.path is not None:
            claim_folder(self.path, marker)
        elif not self.exists(marker) and self.names():
            raise InputError(f"{self}: holds something else (no {marker}); name a new folder")

    @contextlib.contextmanager
    def locked(self) -> Iterator[None]:
        """Keep a second process from writing here; object stores have no locks.

        What an interrupted write left is removed, before and, where no exception ends the block,
        after: a worker may have been killed while it wrote.

        Raises:
            InputError: where another holds it.
        """
        if self.path is None:
            yield
            return
        with folder_lock(self.path):
            self._remove_left_overs(self.path)
            yield
            if self.path.is_dir():  # and was not given another name
                self._remove_left_overs(self.path)

    def _remove_left_overs(self, path: Path) -> None:
        for folder in (path, *path.glob(f"{PARTS}/*/")):
            remove_left_overs(folder)

    @property
    def _fs(self) -> Any:
        file_system = _file_system(self.address)[0]
        file_system.invalidate_cache()  # others write here too
        return file_system

    def _at(self, name: str) -> str:
        root = _file_system(self.address)[1] if self.path is None else self.path.absolute()
        return f"{str(root).rstrip('/')}/{name}".rstrip("/")


def open_folder(where: str | Path | Folder) -> Folder:
    """Return the folder that a path or an address means; nothing is made or looked at.

    Raises:
        InputError: where the address is of no kind that fsspec knows.
        MissingExtraError: where a package is needed to reach it.

    Example:
        >>> open_folder("memory://a/b").name
        'b'
    """
    if isinstance(where, Folder):
        return where
    if isinstance(where, Path) or "://" not in where:
        return Folder(str(Path(where)))
    if where.startswith("file://"):
        return Folder(str(Path(where.removeprefix("file://"))))
    _file_system(where)
    return Folder(where)


@functools.cache
def _file_system(address: str) -> tuple[Any, str]:
    """Return what reaches an address, and the root there."""
    import fsspec.core

    if "://" not in address:
        return fsspec.filesystem("file"), address
    try:
        return fsspec.core.url_to_fs(address)
    except ImportError as error:
        scheme = address.split("://")[0]
        if scheme not in _EXTRAS:
            raise InputError(f"{address}: {error}") from error
        raise MissingExtraError(*_EXTRAS[scheme]) from error
    except ValueError as error:
        raise InputError(f"{address}: {error}") from error
