"""A folder to write a data set into: on a disk of this machine, or any address fsspec knows."""

import contextlib
import functools
import re
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path, PurePosixPath
from typing import Any, TypeVar

from qs3.errors import InputError, MissingExtraError, StorageError
from qs3.files import claim_folder, folder_lock, refuse_link, remove_left_overs, write_bytes

PARTS = ".parts"
"""Sub-folder of what is on its way into a data set."""

_EXTRAS = {
    "s3": ("s3fs", "s3"),
    "s3a": ("s3fs", "s3"),
    "gs": ("gcsfs", "gs"),
    "gcs": ("gcsfs", "gs"),
}
_PAUSES = (0.5, 2.0, 5.0)
"""Seconds after which a store that did not answer is asked again."""
_PASSING = re.compile("Connect|Endpoint|HTTPClient|IncompleteRead|Payload|ServerError|Timeout")
"""In the names of exceptions that may not come again, beside those of the system."""
_Value = TypeVar("_Value")


@dataclass(frozen=True)
class Folder:
    """A folder by its path or address; nothing is made or looked at before it is asked for.

    A file appears whole or not at all: on a disk under a temporary name, synced and then renamed;
    in an object store by one PUT under its final name.
    """

    address: str
    """Path on this machine, or an address such as ``s3://bucket/folder``."""

    def __str__(self) -> str:
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

    def exists(self, name: str) -> bool:
        """Whether there is a file of this name."""
        try:
            return self._ask(lambda system: system.info(self._at(name)))["type"] == "file"
        except (FileNotFoundError, NotADirectoryError):
            return False

    def read(self, name: str) -> bytes:
        """Return a file's bytes.

        Raises:
            InputError: where there is no such file.
        """
        try:
            return self._ask(lambda system: system.cat_file(self._at(name)))
        except FileNotFoundError:
            raise InputError(f"{self.address.rstrip('/')}/{name}: no such file") from None

    def read_many(self, names: Sequence[str]) -> dict[str, bytes]:
        """Return the bytes of several files by their names, fetched side by side."""
        paths = [self._at(name) for name in names]
        how = {"starts": None, "ends": None, "on_error": "raise"}
        contents = self._ask(lambda system: system.cat_ranges(paths, **how)) if paths else []
        return dict(zip(names, contents, strict=True))

    def write(self, name: str, data: bytes) -> None:
        """Write a file, whole or not at all."""
        if self.path is not None:
            write_bytes(self.path / name, data)
            return
        try:
            self._ask(lambda system: system.pipe_file(self._at(name), data))
        except FileNotFoundError as error:
            raise StorageError(f"{self.address}: cannot be written to ({error})") from error

    def names(self, below: str = "") -> list[str]:
        """Return the files below a sub-folder, with its name before theirs, in order."""
        root = self._at("")
        return sorted(
            path[path.index(root) + len(root) + 1 :]
            for path in self._ask(lambda system: _files_below(system, self._at(below)))
        )

    def remove(self, name: str) -> None:
        """Remove a file or a sub-folder, if it is there."""
        with contextlib.suppress(FileNotFoundError):
            self._ask(lambda system: system.rm(self._at(name), recursive=True))

    def size(self, name: str) -> int:
        """Bytes of a file."""
        return int(self._ask(lambda system: system.size(self._at(name))))

    @contextlib.contextmanager
    def claimed(self, marker: str) -> Iterator[None]:
        """Make the folder, and keep a second process from writing into it meanwhile.

        What an interrupted write left is removed, before and, where no exception ends the block,
        after: a worker may have been killed while it wrote. A new folder into which nothing could
        be written goes again. Object stores have no locks.

        Raises:
            InputError: where it holds something else than ours, which ``marker`` tells, or a link
                among the parts; another process holds it; or the disk fails.
        """
        path = self.path
        if path is None:
            if not self.exists(marker) and self.names():
                raise InputError(f"{self}: holds something else (no {marker}); name a new folder")
            yield
            return
        is_new = not path.exists()
        try:
            claim_folder(path, marker)
            with folder_lock(path):
                refuse_link(path / PARTS)
                for part in path.glob(f"{PARTS}/**/*"):  # they will be removed
                    refuse_link(part)
                self._remove_left_overs(path)
                yield
                if path.is_dir():  # and was not given another name
                    self._remove_left_overs(path)
        except OSError as error:
            raise InputError(
                f"{self}: cannot be written to ({error.strerror or error}); mend that and run "
                "the same command again, nothing is lost"
            ) from error
        finally:
            if is_new:
                with contextlib.suppress(OSError):
                    path.rmdir()

    def _remove_left_overs(self, path: Path) -> None:
        for folder in (path, *path.glob(f"{PARTS}/*/")):
            remove_left_overs(folder)

    def _ask(self, question: Callable[[Any], _Value]) -> _Value:
        """Ask the file system; a store that does not answer is asked again, a few times.

        Raises:
            FileNotFoundError: where it answers that there is no such file.
            OSError: as a disk of this machine gives it.
            StorageError: where an object store fails.
        """
        for pause in (*_PAUSES, None):
            try:
                system = _file_system(self.address)[0]
                system.invalidate_cache()  # others write here too
                return question(system)
            except Exception as error:
                fault = _fault_of_store(error)
                if self.path is not None or fault is None:
                    raise
                name = type(fault).__name__
                may_pass = isinstance(fault, OSError) and not isinstance(fault, PermissionError)
                if pause is None or not (may_pass or _PASSING.search(name)):
                    reason = (str(fault).strip().splitlines() or [""])[0]
                    raise StorageError(
                        f"{self.address}: the store does not answer as it should ({name}: "
                        f"{reason}); check network, address and credentials, then run the same "
                        "command again, nothing is lost"
                    ) from error
            time.sleep(pause)
        raise AssertionError("the last pause is None")

    def _at(self, name: str) -> str:
        root = _file_system(self.address)[1] if self.path is None else self.path.absolute()
        return f"{str(root).rstrip('/')}/{name}".rstrip("/")


def _files_below(system: Any, path: str) -> list[str]:
    def refuse(error: OSError) -> None:
        if not isinstance(error, FileNotFoundError | NotADirectoryError):
            raise error

    # `find` takes what cannot be listed for empty.
    places = system.walk(path, on_error=refuse)
    return [f"{place}/{name}" for place, _, files in places for name in files]


def _fault_of_store(error: Exception) -> BaseException | None:
    """The fault of a store or of the way there that an exception tells; None where it tells none.

    HTTP's file system calls a file missing also where the server did not answer.
    """
    if isinstance(error, FileNotFoundError):
        cause = error.__cause__
        library = type(cause).__module__.split(".")[0]
        absent = cause is None or isinstance(cause, FileNotFoundError)
        absent |= getattr(cause, "status", None) in (404, 410)
        answered = absent or not (library == "aiohttp" or isinstance(cause, OSError))
        return None if answered else cause
    is_own = type(error).__module__.split(".")[0] in ("builtins", "qs3")
    return None if is_own and not isinstance(error, OSError | NotImplementedError) else error


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
