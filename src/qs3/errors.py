"""Errors that a user can act on: one line that names what is wrong and the fix."""

import contextlib
import difflib
import logging
from collections.abc import Iterable, Iterator, Sequence
from contextvars import ContextVar

_log = logging.getLogger(__name__)


class QS3Error(Exception):
    """Base of every error whose message is meant for the user; the command line prints it alone."""


class InputError(QS3Error, ValueError):
    """A file, folder or setting is not usable; the message names it and the fix."""


class StorageError(InputError):
    """The disk is full; no fault of the data."""


class FailedScansError(InputError):
    """Single scans failed; all others are there."""


class UnevenSizesError(InputError):
    """Clouds of several sizes, where one array for all was asked for."""


class MissingCloudsError(InputError):
    """A data set lacks clouds of a kind, such as clean twins."""


_DEBIAN = {"libusb-1.0.so": "libusb-1.0-0", "libgomp.so": "libgomp1", "libGL.so": "libgl1"}
"""Debian's package of a system library that a wheel may lack."""


class MissingExtraError(QS3Error, ImportError):
    """An optional package is not installed, or cannot be loaded (``cause``)."""

    def __init__(self, package: str, extra: str, cause: ImportError | None = None) -> None:
        if cause is None or isinstance(cause, ModuleNotFoundError):
            super().__init__(
                f"{package} is not installed; it comes with the extra {extra!r}: in a checkout of "
                f"qs3, pip install -e '.[{extra}]'"
            )
        else:
            super().__init__(f"{package} cannot be loaded: {describe_import_error(cause)}")


def describe_import_error(error: ImportError) -> str:
    """Return what a package could not load, and how to install it."""
    library = str(error).partition(":")[0]
    for name, package in _DEBIAN.items():
        if library.startswith(name):
            return f"{library}; apt-get install {package}"
    return str(error)


class CannotCompileError(QS3Error, ImportError):
    """This machine cannot compile what is compiled when first used: no fault of one object."""


def no_such(fault: str, name: str, names: Iterable[str], more: str = "") -> InputError:
    """Return the error for an unknown name: ``fault``, the closest valid name, all names, ``more``.

    Example:
        >>> print(no_such("unknown model 'dgcn'", "dgcn", ("pointnet", "dgcnn")))
        unknown model 'dgcn' (did you mean dgcnn?); choose one of pointnet, dgcnn
    """
    names = list(names)
    lower = {other.lower(): other for other in names}
    near = difflib.get_close_matches(name.lower(), lower, n=1)
    aside = f" (did you mean {lower[near[0]]}?)" if near else ""
    return InputError(f"{fault}{aside}; choose one of {', '.join(names)}{more}")


def first_few(names: Sequence[str], most: int = 4) -> str:
    """Return the first of many names, and the number of the others.

    Example:
        >>> first_few(["a", "b", "c"], 2)
        'a, b and 1 more'
    """
    more = f" and {len(names) - most} more" if len(names) > most else ""
    return f"{', '.join(names[:most])}{more}"


TOLD: dict[str, str] = {}
"""Warnings that `say_once` has logged in this process, by their kinds."""
_IS_SILENT = ContextVar("is_silent", default=False)


@contextlib.contextmanager
def without_warnings() -> Iterator[None]:
    """Silence `say_once`, for data that this package made itself."""
    before = _IS_SILENT.set(True)
    try:
        yield
    finally:
        _IS_SILENT.reset(before)


def say_once(text: str, kind: str = "") -> None:
    """Log a warning, once in the life of the process; of several of one ``kind``, the first."""
    if (kind or text) not in TOLD and not _IS_SILENT.get():
        TOLD[kind or text] = text
        _log.warning("%s", text)
