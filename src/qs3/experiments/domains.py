"""Domains of the tables, and the data of each.

The paper's data sets need a request (ScanNet) or have lost their links. Data made here take their
places, under their letters and named as stand-ins in every table; a user's own folders take them
with ``--data``.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from qs3.errors import InputError
from qs3.io.clouds import CloudChoice
from qs3.store.manifest import MANIFEST

REAL_CLOUDS = Path("nyuv2_objects.npz"), Path("sunrgbd_objects.npz")
"""Files of real objects in the shared folder."""
DATA = "data"
"""Folder of the data sets that are made here, in that of a reproduction."""
Kind = Literal["M", "S", "S+C+M", "D", "F", "N", "C", "J", "R", "U", "V", "A"]
"""M: samples of the meshes' surfaces; S: scans of the same meshes by the simulated sensor; S+C+M:
both, and the scans' clean twins; D: scans of other meshes by another sensor; F: their fusion
without noise; N: surfaces of further meshes; J and C: scans from one side with and without noise;
V: scans from a number of views; A: scans by a named sensor; R and U: real objects of NYU Depth v2
and of SUN RGB-D."""


@dataclass(frozen=True)
class Domain:
    """A source or a target of the tables."""

    kind: Kind
    views: int = 0
    """Number of fused views of kind V."""
    sensor: str = ""
    """Sensor preset of kind A."""
    clouds: int = 0
    """Number of clouds to adapt to of kind D; 0 takes all."""

    def __str__(self) -> str:
        """Return its name in folders, such as V3 and A.kinect_v1; nothing reads it back."""
        more = [str(part) for part in (self.sensor, self.clouds) if part]
        return ".".join([f"{self.kind}{self.views or ''}", *more]).replace("-", "_")


@dataclass(frozen=True)
class DataSet:
    """A data set that `qs3.experiments.data.make_plans` describes."""

    kind: Literal["source", "held", "jitter", "views", "target", "fused", "second", "sensor"]
    views: int = 0
    """Number of fused views of ``views``."""
    sensor: str = ""
    """Sensor preset of ``sensor``."""

    @property
    def name(self) -> str:
        """Name of its folder."""
        return "-".join(str(part) for part in (self.kind, self.views, self.sensor) if part)


@dataclass(frozen=True)
class Part:
    """Clouds that a run reads."""

    data: DataSet | Path
    """Made here, a path of the user's, or a file of the shared folder (`REAL_CLOUDS`)."""
    split: str | None
    """Part of the data; None takes all."""
    cloud: CloudChoice
    """Cloud of a generated data set."""
    count: int | None = None
    """Number of the user's clouds. Of data made here so many are taken; None takes all."""
    checksum: str = ""
    """Checksum of the user's clouds."""

    def at_hand(self, shared: Path | None) -> bool:
        """Return False for real objects whose file is missing."""
        real = self.data in REAL_CLOUDS
        return not real or (shared is not None and (shared / str(self.data)).is_file())

    def locate(self, out: Path, shared: Path | None) -> Path:
        """Return the path of the clouds: made below ``out``, or in the shared folder."""
        if isinstance(self.data, DataSet):
            return out / DATA / self.data.name
        if self.data not in REAL_CLOUDS:
            return self.data
        if shared is None or not self.at_hand(shared):
            raise InputError(
                f"domains R and U need {self.data}; set QS3_SHARED_DATA to the folder that has "
                "it, or choose --tasks without them"
            )
        return shared / self.data


@dataclass(frozen=True)
class DomainData:
    """Data of a domain."""

    title: str
    """Name in tables and pictures; docs/reproduction.md describes it."""
    train: Part
    """Clouds to train on or to adapt to."""
    test: Part | None
    """Clouds to score on."""
    stands_for: str = ""
    """Data set of the paper whose place it takes."""
    own: bool = False
    """True if it is the user's."""


Own = Mapping[str, DomainData]
"""The user's data sets, by the kind of domain whose place they take."""


def _made(
    title: str,
    train: DataSet,
    test: DataSet | None,
    cloud: CloudChoice = "points",
    stands_for: str = "",
) -> DomainData:
    test_part = None if test is None else Part(test, "test", cloud)
    return DomainData(title, Part(train, "train", cloud), test_part, stands_for)


_SOURCE, _HELD, _TARGET = DataSet("source"), DataSet("held"), DataSet("target")
_FUSED, _SECOND, _JITTER = DataSet("fused"), DataSet("second"), DataSet("jitter")
_NYU, _SUN = REAL_CLOUDS
_MADE: Mapping[str, DomainData] = {
    "M": _made("M: surface samples", _SOURCE, _HELD, "surface", "ModelNet10"),
    "S": _made("S: scans", _SOURCE, _HELD, stands_for="SpeckleNet10"),
    "D": _made("D: one view, other sensor", _TARGET, _TARGET, stands_for="DepthScanNet10"),
    "F": _made("F: fusion without noise", _FUSED, _FUSED, "clean", "ScanNet10 (S*)"),
    "N": _made("N: surface samples of other meshes", _SECOND, _SECOND, "surface", "ShapeNet10"),
    "C": _made("C: one-sided, without noise", _JITTER, None, "clean"),
    "J": _made("J: one-sided scans", _JITTER, None),
    "S+C+M": _made("S+C+M: scans, their clean twins, surface samples", _SOURCE, None, "all"),
    # Blocks of frames in the order of filming, so that no room is on both sides.
    "R": DomainData(
        "R: real NYU Depth v2 objects",
        Part(_NYU, "strict-dev", "points", 520),
        Part(_NYU, "strict-check", "points", 300),
    ),
    "U": DomainData(
        "U: real SUN RGB-D objects", Part(_SUN, None, "points", 32), Part(_SUN, None, "points", 32)
    ),
}


def data_of(domain: Domain, own: Own | None = None) -> DomainData:
    """Return the data of a domain; the user's own come first."""
    if own and domain.kind in own:
        return own[domain.kind]
    if domain.kind == "A":
        scans = DataSet("sensor", sensor=domain.sensor)
        return _made(f"scans by {domain.sensor}", scans, scans)
    if domain.kind == "V":
        title = f"scans from {domain.views} view{'s' * (domain.views > 1)}"
        return _made(title, DataSet("views", views=domain.views), None)
    made = _MADE[domain.kind]
    return replace(made, train=replace(made.train, count=domain.clouds or made.train.count))


def parse_own(given: Sequence[str]) -> dict[str, DomainData]:
    """Read the user's data sets, each ``NAME=PATH`` or ``NAME=PATH:TRAIN:TEST``."""
    own: dict[str, DomainData] = {}
    for text in given:
        kind, equals, rest = text.partition("=")
        path, train, test = rest, "train", "test"
        if not Path(path).exists() and rest.count(":") > 1:
            path, train, test = rest.rsplit(":", 2)
        if not equals or not path or kind in own:
            raise InputError(f"--data {text}: name each domain once, as NAME=PATH[:TRAIN:TEST]")
        if kind not in _MADE:
            raise InputError(f"--data {text}: the domains are {', '.join(_MADE)}")
        if not Path(path).exists():
            raise InputError(f"--data {text}: {path} does not exist; name a folder or a file")
        whole = Path(path).resolve()
        # Samples of surfaces are one of the clouds of a data set of `qs3 generate`.
        cloud = _MADE[kind].train.cloud if (whole / MANIFEST).is_file() else "points"
        parts = Part(whole, train or None, cloud), Part(whole, test or None, cloud)
        own[kind] = DomainData(f"{kind}: {whole.name}", *parts, own=True)
    return own
