"""The witness of a run: its CAD, compared with a scan beside what the forest says."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Float32

from qs3.errors import InputError
from qs3.files import open_arrays, write_arrays
from qs3.parts import LIBRARY, WITNESS
from qs3.parts.forest_and_cad import Fusion
from qs3.parts.library import Library
from qs3.parts.locating import Candidate, Location, compare, located, scan_of
from qs3.parts.places import NOWHERE, Place
from qs3.parts.pose_values import best_of
from qs3.parts.scan import Scan
from qs3.points.clusters import distinct

SEARCHED = 5
"""Number of likeliest classes whose CAD is compared with a scan."""
_NEGLIGIBLE = 0.01
"""Probability above which a further class is compared."""
FORMAT = 8
Known = dict[tuple[frozenset[str], bool], list[Candidate]]
"""Comparisons of a scan with some classes, with or without the place of its camera."""


@dataclass(frozen=True)
class Seen:
    """What forest and CAD say together about one scan."""

    probabilities: Mapping[str, float]
    """Of each class, likeliest first."""
    candidates: tuple[Candidate, ...] = ()
    """The best pose of each CAD file that was compared and can hold the scan, best first."""
    compared: frozenset[str] = frozenset()
    """Classes whose CAD was compared."""

    @property
    def best(self) -> Candidate | None:
        """The best pose of the likeliest class; None if none of its CAD can hold the scan."""
        return best_of(self.candidates, next(iter(self.probabilities)))

    def disagreement(self, class_names: Sequence[str]) -> Float[np.ndarray, "k"]:
        """Return that of the best CAD file of each class; infinite without a pose."""
        found = [best_of(self.candidates, name) for name in class_names]
        return np.array([np.inf if best is None else best.disagreement for best in found])

    def agreed(self, class_names: Sequence[str]) -> Float[np.ndarray, "k 3"]:
        """Return misfit, residual in metres, and surprise of the best CAD file of each class.

        The first is NaN for a class that was not compared, and ∞ if none of its CAD can hold the
        scan; the others are then NaN.
        """
        found = {name: (np.inf if name in self.compared else np.nan, np.nan, np.nan)
                 for name in class_names}  # fmt: skip
        for candidate in reversed(self.candidates):
            found[candidate.class_name] = candidate.misfit, candidate.residual, candidate.surprise
        return np.array([*found.values()])


@dataclass(frozen=True)
class Witness:
    """The CAD of a run, and weights of its agreement with a scan."""

    library: Library
    edges: Mapping[str, Float32[np.ndarray, "e 2 3"]]
    """Ends of the sharp edges of each CAD file, in metres and in the axes of the file."""
    fusion: Fusion = field(default_factory=Fusion)
    """Weights and limits of scans of whose place nothing is known."""
    placed: Fusion | None = None
    """Those of scans whose table is known; None if the simulated scans do not know theirs."""

    def look(
        self,
        forest: Mapping[str, float],
        points: Float[np.ndarray, "n 3"],
        place: Place = NOWHERE,
        known: Known | None = None,
    ) -> Seen:
        """Compare the CAD of the likeliest classes with a scan in metres.

        If no pose of theirs is good, they are compared as if the camera were not known, as its
        place may be wrong; then the CAD of the other classes is compared as well.

        Args:
            forest: Probabilities of all classes.
            points: The scan.
            place: What is known of its place.
            known: What was compared with the scan already, by the same library; it gets the rest.
        """
        count, fusion = len(distinct(points)), self.fusion_for(place)
        known, scans = {} if known is None else known, dict[bool, Scan]()

        def comparison(names: Sequence[str], place: Place) -> list[Candidate]:
            is_free = place.camera is None
            key = frozenset(names), is_free
            if key not in known:
                if is_free not in scans:
                    scans[is_free] = scan_of(points, place)
                known[key] = compare(self.library.only(names), scans[is_free], place)
            return known[key]

        ranked = sorted(forest, key=lambda name: -forest[name])
        few = ranked[:SEARCHED]
        few += [name for name in ranked[SEARCHED:] if forest[name] > _NEGLIGIBLE]
        found = _judged(located(comparison(few, place)), fusion)
        if found.lost and place.camera is not None:
            both = [*found.candidates, *comparison(few, replace(place, camera=None))]
            both.sort(key=lambda candidate: candidate.agreement)
            better = {candidate.cad: candidate for candidate in both}.values()
            found = _judged(located(better), fusion)
        others = [name for name in ranked if name not in few]
        if found.lost and others:
            found = _judged(located((*found.candidates, *comparison(others, place))), fusion)
            few = ranked
        return _weighed(Seen(forest, found.candidates, frozenset(few)), count, fusion)

    def fusion_for(self, place: Place) -> Fusion:
        """Return the weights and limits for a scan: those of placed ones if its table is known.

        They were measured with the camera too, if each simulated scan has one view.
        """
        return self.placed if place.on_table and self.placed is not None else self.fusion

    def of_scans(self, found: Iterable[tuple[Place, str, float]]) -> "Witness":
        """Return the same with limits for the camera of a user's scans (`Fusion.of_scans`).

        Args:
            found: Place, answered class and disagreement of each scan.
        """
        placed: list[tuple[str, float]] = []
        free: list[tuple[str, float]] = []
        for place, name, disagreement in found:
            some = free if self.fusion_for(place) is self.fusion else placed
            some.append((name, disagreement))
        limits = self.placed and self.placed.of_scans(placed)
        return replace(self, fusion=self.fusion.of_scans(free), placed=limits)

    def save(self, folder: Path) -> None:
        """Write the two files of the witness into the folder of a run."""
        self.library.save(folder / LIBRARY)
        arrays = {f"edges/{i}": np.ascontiguousarray(self.edges[part.cad], np.float32)
                  for i, part in enumerate(self.library)}  # fmt: skip
        placed = None if self.placed is None else asdict(self.placed)
        facts = {"format": FORMAT, "fusion": asdict(self.fusion), "placed": placed}
        write_arrays(folder / WITNESS, arrays, facts)

    @classmethod
    def read(cls, folder: Path, class_names: Sequence[str]) -> "Witness":
        """Read the witness of a run; damaged files, or CAD of other classes, raise `InputError`."""
        library, path = Library.read(folder / LIBRARY), folder / WITNESS
        with open_arrays(path, "the witness of a run") as (handle, facts):
            if facts["format"] != FORMAT:
                raise InputError(f"has format {facts['format']!r}, not {FORMAT}; train again")
            edges = {p.cad: handle.get_tensor(f"edges/{i}") for i, p in enumerate(library)}
            fusion = _fusion_of(facts["fusion"])
            placed = None if facts["placed"] is None else _fusion_of(facts["placed"])
            for cad, lines in edges.items():
                if lines.dtype != np.float32 or lines.shape[1:] != (2, 3):
                    raise InputError(f"edges of {cad!r} have another type or shape")
                if not np.isfinite(lines).all():
                    raise InputError(f"edges of {cad!r} are not finite")
        if {*library.class_names} != {*class_names}:
            raise InputError(f"{folder / LIBRARY}: holds CAD of {', '.join(library.class_names)}, "
                             f"and the forest knows {', '.join(class_names)}")  # fmt: skip
        return cls(library, edges, fusion, placed)


def _fusion_of(facts: Mapping[str, Any]) -> Fusion:
    quantiles = {name: tuple(facts[name]) for name in ("misfits", "joint")}
    typical = {name: float(facts["typical"][name]) for name in facts["typical"]}
    weights = {name: facts[name] for name in ("forest", "witness", "residual", "view", "worst")}
    known = {name: facts.get(name, 0.0) for name in ("calm", "shown")}
    return Fusion(typical=typical, **known, **quantiles, **weights)


def _judged(found: Location, fusion: Fusion) -> Location:
    """Return what was found, lost if hardly a simulated scan of its class agrees so badly."""
    judged = []
    for candidate in found.candidates:
        lost = fusion.lost(candidate.class_name, candidate.disagreement, candidate.visible)
        judged.append(candidate if lost is None else replace(candidate, lost=lost))
    return Location(tuple(judged))


def _weighed(seen: Seen, count: int, fusion: Fusion) -> Seen:
    names, shares = [*seen.probabilities], np.array([*seen.probabilities.values()])
    shares = fusion.probabilities(shares, seen.agreed(names), count)
    order = np.argsort(-shares, kind="stable")
    return replace(seen, probabilities={names[i]: float(shares[i]) for i in order})
