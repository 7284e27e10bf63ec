"""Domains of the tables, and the data of each.

The paper's data sets need a request (ScanNet) or have lost their links. Data made here take their
places, under their letters and named as stand-ins in every table; a user's own folders take them
with ``--data``.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal

from qs3.clouds.types import CloudChoice
from qs3.errors import InputError
from qs3.store.manifest import MANIFEST

REAL_CLOUDS = Path("nyuv2_objects.npz"), Path("sunrgbd_objects.npz")
"""Files of real objects in the shared folder."""
DATA = "data"
"""Folder of the data sets that are made here, in that of a reproduction."""
Kind = Literal["M", "S", "S+C+M", "D", "F", "C", "J", "R", "U", "V", "A"]
"""M: samples of the meshes' surfaces; S: scans of the same meshes by the simulated sensor; S+C+M:
both, and the scans' clean twins; D: scans of other meshes by another sensor; F: the same
without noise, from as many views as S; J and C: scans from one side with and without noise; V:
scans from a number of views; A: scans by a named sensor; R and U: real objects of NYU Depth v2 and
of SUN RGB-D."""
Generated = tuple[str | int, ...]
"""A data set that `qs3.paper.prepare.make_plans` describes: a word, and the number of fused
views of ``views`` or the preset of ``sensor``."""


def folder_of_data(data: Generated) -> str:
    """Return the name of the folder of a data set."""
    return "-".join(map(str, data))


@dataclass(frozen=True)
class Part:
    """Clouds that a run reads."""

    data: Path | Generated
    """Generated here, a path of the user's, or a file of the shared folder (`REAL_CLOUDS`)."""
    split: str | None
    """Part of the data; None takes all."""
    cloud: CloudChoice
    count: int | None = None
    """Number of the user's clouds, or of clouds made here to take; None takes all."""
    checksum: str = ""
    """Checksum of the user's clouds."""

    @property
    def name(self) -> str:
        """Name of its folder or file."""
        return self.data.name if isinstance(self.data, Path) else folder_of_data(self.data)

    def locate(self, out: Path, shared: Path | None) -> Path:
        """Return the path of the clouds: made below ``out``, or in the shared folder."""
        if self.data not in REAL_CLOUDS:
            return self.data if isinstance(self.data, Path) else out / DATA / self.name
        if shared is None or not (shared / self.name).is_file():
            raise InputError(
                f"domains R and U need {self.data}; set QS3_SHARED_DATA to the folder that has "
                "it, or choose --tasks without them"
            )
        return shared / self.name


@dataclass(frozen=True)
class Domain:
    """A source or a target of the tables."""

    title: str
    """Name in tables and pictures; docs/reproduction.md describes it."""
    train: Part
    """Clouds to train on or to adapt to."""
    test: Part | None
    """Clouds to score on."""
    stands_for: str = ""
    """Data set of the paper whose place it takes."""
    is_users: bool = False


UserData = Mapping[str, Domain]
"""The user's data sets, by the kind of domain whose place they take."""


def _stand_in(
    title: str,
    train: Generated,
    test: Generated = (),
    cloud: CloudChoice = "points",
    stands_for: str = "",
) -> Domain:
    scored = Part(test, "test", cloud) if test else None
    return Domain(title, Part(train, "train", cloud), scored, stands_for)


_SOURCE, _HELD, _TARGET, _FUSED, _JITTER = (
    (word,) for word in ("source", "held", "target", "fused", "jitter")
)
_NYU, _SUN = REAL_CLOUDS
_MADE: Mapping[str, Domain] = {
    "M": _stand_in("M: surface samples", _SOURCE, _HELD, "surface", "ModelNet10"),
    "S": _stand_in("S: scans", _SOURCE, _HELD, stands_for="SpeckleNet10"),
    "D": _stand_in("D: one view, other sensor", _TARGET, _TARGET, stands_for="DepthScanNet10"),
    "F": _stand_in("F: D's objects without noise", _FUSED, _FUSED, "clean", "ScanNet10 (S*)"),
    "C": _stand_in("C: one-sided, without noise", _JITTER, cloud="clean"),
    "J": _stand_in("J: one-sided scans", _JITTER),
    "S+C+M": _stand_in("S+C+M: scans, their clean twins, surface samples", _SOURCE, cloud="all"),
    # Blocks of frames in the order of filming, so that no room is on both sides.
    "R": Domain(
        "R: real NYU Depth v2 objects",
        Part(_NYU, "strict-dev", "points", 520),
        Part(_NYU, "strict-check", "points", 300),
    ),
    "U": Domain(
        "U: real SUN RGB-D objects", Part(_SUN, None, "points", 32), Part(_SUN, None, "points", 32)
    ),
}


def find_domain(
    kind: Kind,
    data: UserData | None = None,
    views: int | None = None,
    sensor: str = "",
    clouds: int | None = None,
) -> Domain:
    """Return a domain; the user's own come first.

    ``views`` are those of kind V, ``sensor`` is that of kind A, and of kind D so many ``clouds``
    are adapted to.
    """
    if data and kind in data:
        return data[kind]
    if kind == "A":
        return _stand_in(f"scans by {sensor}", ("sensor", sensor), ("sensor", sensor))
    if kind == "V":
        return _stand_in(f"scans from {views} view{'s' * (views != 1)}", ("views", views or 0))
    standard = _MADE[kind]
    if clouds is None:
        return standard
    return replace(standard, train=replace(standard.train, count=clouds))


def parse_data(pairs: Sequence[str]) -> dict[str, Domain]:
    """Read the user's data sets, each ``NAME=PATH`` or ``NAME=PATH:TRAIN:TEST``."""
    domains: dict[str, Domain] = {}
    for text in pairs:
        kind, equals, rest = text.partition("=")
        path, train, test = rest, "train", "test"
        if not Path(path).exists() and rest.count(":") > 1:
            path, train, test = rest.rsplit(":", 2)
        if not equals or not path or kind in domains:
            raise InputError(f"--data {text}: name each domain once, as NAME=PATH[:TRAIN:TEST]")
        if kind not in _MADE:
            raise InputError(f"--data {text}: the domains are {', '.join(_MADE)}")
        if not Path(path).exists():
            raise InputError(f"--data {text}: {path} does not exist; name a folder or a file")
        whole = Path(path).resolve()
        # Samples of surfaces are one of the clouds of a data set of `qs3 generate`.
        cloud = _MADE[kind].train.cloud if (whole / MANIFEST).is_file() else "points"
        parts = Part(whole, train or None, cloud), Part(whole, test or None, cloud)
        domains[kind] = Domain(f"{kind}: {whole.name}", *parts, is_users=True)
    return domains
