"""The witness of a run: its CAD, compared with a scan beside what the forest says."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path

import numpy as np
import safetensors
import safetensors.numpy
from jaxtyping import Float, Float32

from qs3.errors import InputError
from qs3.files import parse_json, write_bytes
from qs3.parts import LIBRARY, WITNESS
from qs3.parts.forest_and_cad import Fusion
from qs3.parts.library import Library
from qs3.parts.locating import Candidate, Location, compare, located, scan_of
from qs3.parts.places import NOWHERE, Place
from qs3.parts.scan import FEWEST
from qs3.reading import reading

SEARCHED = 5
"""Number of likeliest classes whose CAD is compared with a scan."""
_NEGLIGIBLE = 0.01
"""Probability above which a further class is compared."""
_FORMAT = 7


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
        name = next(iter(self.probabilities))
        return next((one for one in self.candidates if one.class_name == name), None)

    def disagreement(self, class_names: Sequence[str]) -> Float[np.ndarray, "k"]:
        """Return that of the best CAD file of each class; infinite without a pose."""
        found = {one.class_name: one.disagreement for one in reversed(self.candidates)}
        return np.array([found.get(name, np.inf) for name in class_names])

    def agreed(self, class_names: Sequence[str]) -> Float[np.ndarray, "k 3"]:
        """Return misfit, residual in metres, and surprise of the best CAD file of each class.

        The first is NaN for a class that was not compared, and ∞ if none of its CAD can hold the
        scan; the others are then NaN.
        """
        found = {name: (np.inf if name in self.compared else np.nan, np.nan, np.nan)
                 for name in class_names}  # fmt: skip
        for one in reversed(self.candidates):
            found[one.class_name] = one.misfit, one.residual, one.surprise
        return np.array([*found.values()])


@dataclass(frozen=True)
class Witness:
    """The CAD of a run, and weights of its agreement with a scan."""

    library: Library
    edges: Mapping[str, Float32[np.ndarray, "e 2 3"]]
    """Ends of the sharp edges of each CAD file, in metres and in the axes of the file."""
    fusion: Fusion = field(default_factory=Fusion)

    def look(
        self,
        forest: Mapping[str, float],
        points: Float[np.ndarray, "n 3"],
        place: Place = NOWHERE,
    ) -> Seen:
        """Compare the CAD of the likeliest classes with a scan in metres.

        If no pose of theirs is good, they are compared as if nothing were known of the place, as
        limits are measured so and stereo may lift a part off its table; then the CAD of the other
        classes is compared as well. A scan of fewer than 12 distinct points has no pose, and says
        little.

        Args:
            forest: Probabilities of all classes.
            points: The scan.
            place: What is known of its place.
        """
        count = len(np.unique(points, axis=0))
        if count < FEWEST:
            return self._weighed(Seen(forest), count)
        ranked = sorted(forest, key=lambda name: -forest[name])
        few = ranked[:SEARCHED]
        few += [name for name in ranked[SEARCHED:] if forest[name] > _NEGLIGIBLE]
        scan = scan_of(points, place)
        likely = self.library.only(few)
        found = self._judged(located(compare(likely, scan, place)))
        if found.lost and place != NOWHERE:
            free = compare(likely, scan_of(points, NOWHERE), NOWHERE)
            both = sorted((*free, *found.candidates), key=lambda one: one.agreement)
            found = self._judged(located({one.cad: one for one in both}.values()))  # the better
        others = [name for name in ranked if name not in few]
        if found.lost and others:
            more = compare(self.library.only(others), scan, place)
            found = self._judged(located((*found.candidates, *more)))
            few = ranked
        return self._weighed(Seen(forest, found.candidates, frozenset(few)), count)

    def _judged(self, found: Location) -> Location:
        """Return what was found, lost if hardly a simulated scan of its class agrees so badly."""
        judged = []
        for one in found.candidates:
            lost = self.fusion.lost(one.class_name, one.disagreement)
            judged.append(one if lost is None else replace(one, lost=lost))
        return Location(tuple(judged))

    def _weighed(self, seen: Seen, count: int) -> Seen:
        names, shares = [*seen.probabilities], np.array([*seen.probabilities.values()])
        shares = self.fusion.probabilities(shares, seen.agreed(names), count)
        order = np.argsort(-shares, kind="stable")
        return replace(seen, probabilities={names[i]: float(shares[i]) for i in order})

    def save(self, folder: Path) -> None:
        """Write the two files of the witness into the folder of a run."""
        self.library.save(folder / LIBRARY)
        arrays = {f"edges/{i}": np.ascontiguousarray(self.edges[part.cad], np.float32)
                  for i, part in enumerate(self.library)}  # fmt: skip
        facts = {"format": _FORMAT, "fusion": asdict(self.fusion)}
        facts = json.dumps(facts, allow_nan=False)
        write_bytes(folder / WITNESS, safetensors.numpy.save(arrays, {"qs3": facts}))

    @classmethod
    def read(cls, folder: Path, class_names: Sequence[str]) -> "Witness":
        """Read the witness of a run; damaged files, or CAD of other classes, raise `InputError`."""
        library, path = Library.read(folder / LIBRARY), folder / WITNESS
        with reading(path, "the witness of a run"):
            with safetensors.safe_open(path, framework="numpy") as handle:  # pyright: ignore[reportPrivateImportUsage]
                facts = parse_json((handle.metadata() or {})["qs3"], path)
                if facts["format"] != _FORMAT:
                    raise InputError(f"has format {facts['format']!r}, not {_FORMAT}; train anew")
                edges = {p.cad: handle.get_tensor(f"edges/{i}") for i, p in enumerate(library)}
            given = facts["fusion"]
            quantiles = {name: tuple(given[name]) for name in ("misfits", "joint")}
            typical = {name: float(given["typical"][name]) for name in given["typical"]}
            numbers = ("forest", "witness", "residual", "view", "worst", "camera")
            weights = {name: given[name] for name in numbers}
            fusion = Fusion(typical=typical, **quantiles, **weights)
            for cad, lines in edges.items():
                if lines.dtype != np.float32 or lines.shape[1:] != (2, 3):
                    raise InputError(f"edges of {cad!r} have another type or shape")
                if not np.isfinite(lines).all():
                    raise InputError(f"edges of {cad!r} are not finite")
        if {*library.class_names} != {*class_names}:
            raise InputError(f"{folder / LIBRARY}: holds CAD of {', '.join(library.class_names)}, "
                             f"and the forest knows {', '.join(class_names)}")  # fmt: skip
        return cls(library, edges, fusion)
