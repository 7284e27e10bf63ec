"""Known parts: a forest ranks them, and the visible surface of their CAD decides.

The comparison with CAD names parts and finds their poses without a simulation and without training.
"""

from typing import TYPE_CHECKING

from qs3.lazy import loader

if TYPE_CHECKING:
    from qs3.parts.descriptor import describe as describe
    from qs3.parts.descriptor import describe_varied as describe_varied
    from qs3.parts.deviation import locate_all as locate_all
    from qs3.parts.forest import Forest as Forest
    from qs3.parts.forest import fit_forest as fit_forest
    from qs3.parts.library import Library as Library
    from qs3.parts.locating import Candidate as Candidate
    from qs3.parts.locating import Location as Location
    from qs3.parts.locating import locate as locate
    from qs3.parts.places import Place as Place
    from qs3.parts.scenes.finding import find as find
    from qs3.parts.scenes.found import FindSettings as FindSettings
    from qs3.parts.scenes.found import FoundPart as FoundPart
    from qs3.parts.scenes.found import FoundParts as FoundParts

LIBRARY, WITNESS = "library.safetensors", "witness.safetensors"
"""Files of a run: what cameras see of its CAD, and what is measured about the comparison."""

__getattr__ = loader(__name__)
