"""A folder to write a data set into: on a disk of this machine, or any address fsspec knows."""

import contextlib
import functools
import os
import shutil
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any

from qs3.errors import InputError, MissingExtraError
from qs3.files import claim_folder, remove_left_overs, write_bytes

PARTS = ".parts"
"""Sub-folder of what is on its way into a data set."""

_EXTRAS = {
    "s3": ("s3fs", "s3"),
    "s3a": ("s3fs", "s3"),
    "gs": ("gcsfs", "gs"),
    "gcs": ("gcsfs", "gs"),
}


@dataclass(frozen=True)
class LocalFolder:
    """A folder of this machine's file system. Files appear whole, synced to disk, or not at all."""

    path: Path
    """Where it is."""

    def __str__(self) -> str:
        """Return the path."""
        return str(self.path)

    @property
    def name(self) -> str:
        """Last part of the path."""
        return self.path.resolve().name

    def exists(self, name: str) -> bool:
        """Whether there is a file of this name."""
        return (self.path / name).is_file()

    def read(self, name: str) -> bytes:
        """Return a file's bytes.

        Raises:
            InputError: where there is no such file.
        """
        if not self.exists(name):
            raise InputError(f"{self.path / name}: no such file")
        return (self.path / name).read_bytes()

    def read_many(self, names: Sequence[str]) -> dict[str, bytes]:
        """Return the bytes of several files by their names."""
        return {name: self.read(name) for name in names}

    def write(self, name: str, data: bytes) -> None:
        """Write a file under a temporary name, sync it and rename it."""
        write_bytes(self.path / name, data)

    def names(self, below: str = "") -> list[str]:
        """Return the files below a sub-folder, with its name before theirs, in order."""
        root = self.path / below
        if not root.is_dir():
            return []
        found = (Path(folder) / file for folder, _, files in os.walk(root) for file in files)
        return sorted(path.relative_to(self.path).as_posix() for path in found)

    def remove(self, name: str) -> None:
        """Remove a file or a sub-folder, if it is there."""
        path = self.path / name
        if path.is_dir():
            shutil.rmtree(path)
        else:
            path.unlink(missing_ok=True)

    def size(self, name: str) -> int:
        """Bytes of a file."""
        return (self.path / name).stat().st_size

    def claim(self, marker: str) -> None:
        """Make the folder; refuse one that holds something else than ours, told by ``marker``."""
        claim_folder(self.path, marker)

    @property
    def present(self) -> bool:
        """Whether the folder is there."""
        return self.path.is_dir()

    @contextlib.contextmanager
    def locked(self) -> Iterator[None]:
        """Keep a second process from writing here at the same time; a killed one lets go.

        What an interrupted write left is removed, before and, where no exception ends the block,
        after: a worker may have been killed while it wrote.

        Raises:
            InputError: where another holds it.
        """
        try:
            import fcntl
        except ImportError:  # Windows
            yield
            return
        handle = os.open(self.path, os.O_RDONLY)
        try:
            try:
                fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError:
                raise InputError(
                    f"{self.path}: another qs3 is writing into this folder; wait for it, or name "
                    "another one"
                ) from None
            except OSError:  # a file system without locks
                yield  # and with no way to know whether somebody else is writing
                return
            self._remove_left_overs()
            yield
            if self.path.is_dir():  # and was not given another name
                self._remove_left_overs()
        finally:
            os.close(handle)

    def _remove_left_overs(self) -> None:
        for folder in (self.path, *self.path.glob(f"{PARTS}/*/")):
            remove_left_overs(folder)


@dataclass(frozen=True)
class RemoteFolder:
    """A folder of an object store. A file is one PUT under its final name, whole or not at all."""

    url: str
    """Address, such as ``s3://bucket/folder``."""

    def __str__(self) -> str:
        """Return the address."""
        return self.url

    @property
    def name(self) -> str:
        """Last part of the address."""
        return PurePosixPath(self.url).name

    @property
    def _fs(self) -> Any:
        return _file_system(self.url)[0]

    def _path(self, name: str) -> str:
        root = _file_system(self.url)[1].rstrip("/")
        return f"{root}/{name}" if name else root

    def exists(self, name: str) -> bool:
        """Whether there is a file of this name."""
        self._fs.invalidate_cache()
        return bool(self._fs.isfile(self._path(name)))

    def read(self, name: str) -> bytes:
        """Return a file's bytes.

        Raises:
            InputError: where there is no such file.
        """
        try:
            return self._fs.cat_file(self._path(name))
        except FileNotFoundError:
            raise InputError(f"{self.url.rstrip('/')}/{name}: no such file") from None

    def read_many(self, names: Sequence[str]) -> dict[str, bytes]:
        """Return the bytes of several files by their names, fetched side by side."""
        if not names:
            return {}
        paths = {self._path(name): name for name in names}
        found = self._fs.cat(list(paths))
        found = found if isinstance(found, dict) else {next(iter(paths)): found}
        return {name: found[path] for path, name in paths.items()}

    def write(self, name: str, data: bytes) -> None:
        """Write a file by one PUT."""
        self._fs.pipe_file(self._path(name), data)

    def names(self, below: str = "") -> list[str]:
        """Return the files below a sub-folder, with its name before theirs, in order."""
        self._fs.invalidate_cache()
        root = self._path("")
        try:
            found = self._fs.find(self._path(below))
        except FileNotFoundError:
            return []
        return sorted(path[path.index(root) + len(root) + 1 :] for path in found)

    def remove(self, name: str) -> None:
        """Remove a file or a sub-folder, if it is there."""
        with contextlib.suppress(FileNotFoundError):
            self._fs.rm(self._path(name), recursive=True)
        self._fs.invalidate_cache()

    def size(self, name: str) -> int:
        """Bytes of a file."""
        return int(self._fs.size(self._path(name)))

    def claim(self, marker: str) -> None:
        """Refuse a folder that holds something else than ours, told by ``marker``.

        Raises:
            InputError: where it does.
        """
        if not self.exists(marker) and self.names():
            raise InputError(f"{self.url}: holds something else (no {marker}); name a new folder")

    @property
    def present(self) -> bool:
        """Whether anything is there."""
        return bool(self.names())

    @contextlib.contextmanager
    def locked(self) -> Iterator[None]:
        """Do nothing: object stores have no locks."""
        yield


Folder = LocalFolder | RemoteFolder


def open_folder(where: "str | Path | Folder") -> Folder:
    """Return the folder that a path or an address means; nothing is made or looked at.

    Raises:
        InputError: where the address is of no kind that fsspec knows.
        MissingExtraError: where a package is needed to reach it.

    Example:
        >>> open_folder("memory://a/b").name
        'b'
    """
    if isinstance(where, LocalFolder | RemoteFolder):
        return where
    text = str(where)
    if isinstance(where, Path) or "://" not in text:
        return LocalFolder(Path(where))
    if text.startswith("file://"):
        return LocalFolder(Path(text.removeprefix("file://")))
    _file_system(text)
    return RemoteFolder(text)


@functools.cache
def _file_system(url: str) -> tuple[Any, str]:
    import fsspec.core

    scheme = url.split("://")[0]
    try:
        fs, root = fsspec.core.url_to_fs(url)
    except ImportError as error:
        package, extra = _EXTRAS.get(scheme, (scheme, ""))
        if not extra:
            raise InputError(f"{url}: {error}") from error
        raise MissingExtraError(package, extra) from error
    except ValueError as error:
        raise InputError(f"{url}: {error}") from error
    return fs, root
