"""Domains of the tables: where the clouds of each come from, and what stands in for the paper's.

The paper's data sets cannot be had without asking (ScanNet) or have gone with their links. What is
made here takes their places, under their letters and named as stand-ins in every table; a user's
own folders take them with ``--data``.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from qs3.errors import InputError
from qs3.io.clouds import CloudKind
from qs3.store.manifest import MANIFEST

REAL = "sunrgbd_objects.npz"
REAL_CLOUDS = 32
"""Objects in that file."""
VIEWS, SENSOR = "V", "A."
"""Domains whose name goes on: V3 is the source in three views, A.d435 one sensor's scans."""


@dataclass(frozen=True)
class Domain:
    """Clouds to train on and clouds to score on."""

    title: str
    """What tables and pictures call it; docs/reproduction.md tells the rest."""
    train: str
    """Data set made here, or a path of the user's, to train on or to adapt to."""
    test: str
    """The same, to score on."""
    cloud: CloudKind = "points"
    """Which cloud of a generated data set."""
    train_split: str | None = "train"
    """Part of the first."""
    test_split: str | None = "test"
    """Part of the second."""
    stands_for: str = ""
    """Data set of the paper whose place it takes; empty where it takes none."""
    own: bool = False
    """Whether both are paths of the user's."""


_MADE: Mapping[str, Domain] = {
    "M": Domain("M: surface samples", "source", "held", cloud="surface", stands_for="ModelNet10"),
    "S": Domain("S: scans", "source", "held", stands_for="SpeckleNet10"),
    "D": Domain(
        "D: one view, other sensor",
        "target",
        "target",
        stands_for="DepthScanNet10",
    ),
    "F": Domain(
        "F: fusion without noise",
        "fused",
        "fused",
        cloud="clean",
        stands_for="ScanNet10 (S*)",
    ),
    "N": Domain(
        "N: surface samples of other meshes", "second", "second", "surface", stands_for="ShapeNet10"
    ),
    "C": Domain("C: one-sided, without noise", "jitter", "", cloud="clean"),
    "J": Domain("J: one-sided scans", "jitter", ""),
    "R": Domain("R: real SUN RGB-D objects", REAL, REAL, train_split=None, test_split=None),
}


def domain(name: str, own: Mapping[str, Domain] | None = None) -> Domain:
    """Return a domain by its name; the user's own come first.

    Raises:
        InputError: where there is no such domain.

    Example:
        >>> domain("V3").train, domain("A.kinect_v1").test
        ('views-3', 'sensor-kinect-v1')
    """
    if own and name in own:
        return own[name]
    if name in _MADE:
        return _MADE[name]
    if name.startswith(SENSOR):
        sensor = name.removeprefix(SENSOR).replace("_", "-")
        return Domain(f"scans by {sensor}", f"sensor-{sensor}", f"sensor-{sensor}")
    if name.startswith(VIEWS) and name.removeprefix(VIEWS).isdecimal():
        count = int(name.removeprefix(VIEWS))
        return Domain(f"scans from {count} view{'s' * (count > 1)}", f"views-{count}", "")
    raise InputError(f"unknown domain {name!r}; choose from {', '.join(_MADE)}")


def sensor_domain(sensor: str) -> str:
    """Return the name of the domain of a sensor's scans; a hyphen parts source and target.

    Example:
        >>> sensor_domain("kinect-v1")
        'A.kinect_v1'
    """
    return SENSOR + sensor.replace("-", "_")


def parse_own(given: Sequence[str]) -> dict[str, Domain]:
    """Read the user's data sets: ``NAME=PATH``, or ``NAME=PATH:TRAIN:TEST`` with two parts of it.

    Raises:
        InputError: where one is not of this form, is unknown or comes twice, or is not there.

    Example:
        >>> import tempfile
        >>> folder = tempfile.mkdtemp()
        >>> parse_own([f"D={folder}"])["D"].test_split
        'test'
    """
    found: dict[str, Domain] = {}
    for text in given:
        name, equals, rest = text.partition("=")
        path, train, test = rest, "train", "test"
        if not Path(path).exists() and rest.count(":") > 1:
            path, train, test = rest.rsplit(":", 2)
        if not equals or not path or name in found:
            raise InputError(f"--data {text}: say each domain once, as NAME=PATH[:TRAIN:TEST]")
        if name not in _MADE:
            raise InputError(f"--data {text}: the domains are {', '.join(_MADE)}")
        if not Path(path).exists():
            raise InputError(f"--data {text}: {path} is not there; name a folder or a file")
        whole = Path(path).resolve()
        # Samples of surfaces are one of the clouds of what `qs3 generate` makes.
        cloud = _MADE[name].cloud if (whole / MANIFEST).is_file() else "points"
        found[name] = own_domain(name, str(whole), cloud, train or None, test or None)
    return found


def own_domain(
    name: str, path: str, cloud: CloudKind, train_split: str | None, test_split: str | None
) -> Domain:
    """Return a domain whose clouds are the user's.

    Args:
        name: Domain whose place they take.
        path: Where they are.
        cloud: Which cloud of a generated data set.
        train_split: Part to train on or to adapt to; None takes all.
        test_split: Part to score on; None takes all.

    Raises:
        InputError: where there is no such domain.
    """
    if name not in _MADE:
        raise InputError(f"unknown domain {name!r}; choose from {', '.join(_MADE)}")
    return replace(
        _MADE[name],
        title=f"{name}: {Path(path).name}",
        train=path,
        test=path,
        cloud=cloud,
        train_split=train_split,
        test_split=test_split,
        stands_for="",
        own=True,
    )
