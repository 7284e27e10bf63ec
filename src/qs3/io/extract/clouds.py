"""What the extraction of objects from real scans hands on."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float32


@dataclass(frozen=True)
class ExtractedCloud:
    """One object cut from a real scan."""

    id: str
    """Name, unique in the data set, such as ``scene0000_00/12``."""
    class_name: str
    """Name of its class in the data set, or as the source calls it."""
    points: Float32[np.ndarray, "n 3"]
    """Its points in metres, z up."""
    split: str = ""
    """``train``, ``test`` or empty."""
    source: Mapping[str, Any] = field(default_factory=dict)
    """Where it came from (frames used, points before thinning), as plain values."""


@runtime_checkable
class Unit(Protocol):
    """What is extracted at a time, and lost at a time if the machine stops: a scene, a frame."""

    @property
    def id(self) -> str:
        """Unique name."""
        ...
