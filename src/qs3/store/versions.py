"""Versions of the packages that a result depends on."""

import platform
from importlib.metadata import PackageNotFoundError, version

_PACKAGES = (
    "qs3",
    "mitsuba",
    "numpy",
    "opencv-python-headless",
    "pyarrow",
    "scipy",
    "torch",
    "trimesh",
)


def package_versions() -> dict[str, str]:
    """Return the versions of Python and of the packages that are installed, by name.

    Read from the packages' metadata; nothing is imported.

    Example:
        >>> sorted(package_versions())[:2]
        ['mitsuba', 'numpy']
    """
    found = {"python": platform.python_version()}
    for name in _PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found
