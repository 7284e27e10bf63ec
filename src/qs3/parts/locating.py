"""What is in a scan, for `qs3 locate` and runs: part, CAD file, pose, and how well they agree."""

from collections.abc import Iterable
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float, Shaped

from qs3.checks import check_kind
from qs3.errors import InputError
from qs3.geometry import rigid
from qs3.parts.forest_and_cad import LEAST_MISFIT, LEAST_RESIDUAL
from qs3.parts.library import Library
from qs3.parts.places import NOWHERE, Place
from qs3.parts.refine import Found, begin, first_poses, refine
from qs3.parts.scan import Scan, prepare
from qs3.parts.score import noise_of
from qs3.parts.symmetry import Symmetry
from qs3.parts.views import Part

_LOST = 1.1
"""A pose is no good if it disagrees more than this (`located`). The limit, `_CLEAR` and
`_BY` have about the least sum of known parts that are lost and of foreign parts that are not, over
simulated scans alone (the embedded parts by d435 and kinect-v1, twelve machine parts by an Xtion,
eighteen by a ray caster; foreign means that a scan's own CAD file is left out), of those at which
the foreign shapes of the tests are lost and the views of the bunny are not. The noise of a camera
is not known here: behind a matcher that smooths by several noises (d435), most known parts are
lost. A run measures its own limit (`Fusion.lost`)."""
_RARE = 0.5
"""Weight of how rare a view is in the rank of a CAD file: of 0, 0.5, 1 and 2 the one by which CAD
alone names the most simulated scans (twelve machine parts by an Xtion)."""
_POSITIVE = 1e-3
"""Misfits that are less are as good."""
_CLEAR, _BY = 4.0, 2
"""A pose is at most so many times better than those of the other CAD files, and the power of that:
a known part agrees far better with its own file than with others, whatever the noise."""
_LONG = 0.6
"""Diameter of the scan in those of the part below which that does not count: a scrap may agree far
better with one file by accident. Nearly all simulated scans are longer."""
_TOO_LARGE, _PARTLY = 20.0, 1.3
"""Diameters of the largest CAD at which a scan is in another unit, and of a CAD that a scan may
have: a larger scan holds something else."""

_FIRST, _LATER, _NEAR, _RIVAL, _MARGIN = 2, 5, 6, 2.0, 10.0
"""Poses of each CAD file that are refined, the first and those of the others that the first stage
leaves best. The latter are looked at for so many files, if they disagree by no more than this
multiple of the best file, and a margin."""
_FARTHEST = 1000.0
"""Metres of a camera from what it scans."""
_VAGUE = 0.1
"""Residual or noise, in diameters of the part, from which on a pose says nothing. Real and
simulated scans of known parts reach 0.08 (twelve machine parts by an Xtion, six larger ones by
d435)."""
_END = 0.35
"""Diameter of the scan in those of the part below which it shows a spot or an end of it: that of a
rod does not show how long it is, and a scrap of anything looks like one."""
_SHOWN = 0.5
"""Visible share below which a scan does not determine a pose; real views of known parts show 0.54
and more. A run measures its own limit (`Fusion.shown`)."""


@dataclass(frozen=True)
class Candidate:
    """The best pose of one CAD file in a scan."""

    class_name: str
    cad: str
    pose: Float[np.ndarray, "4 4"]
    """From the file's vertices as they stand on disk, in metres and times `scale`, to the scan: of
    all poses that look the same the one that is turned least."""
    symmetry: Symmetry
    """Of the CAD: ``pose @ equals`` are the poses that look the same."""
    residual: float
    """Metres: root mean square distance between the scan and the visible surface, both ways, over
    the nearest 92 % of each."""
    off: float
    """Metres: the same, of the distances from the scan to the visible surface alone."""
    visible: float
    """Share of the picture of the visible surface, from the camera's side, that the scan covers."""
    explained: float
    """Share of the scan that lies on the visible surface."""
    noise: float
    """Metres that counted as one noise."""
    misfit: float
    """Compares CAD files on one scan, the less the better: `Score.misfit`, and what the height on
    the table adds to it."""
    surprise: float = 0.0
    """How rare the view is: minus the logarithm of `qs3.parts.views.Part.odds`."""
    beaten: float = 1.0
    """How many times less the misfit of the CAD of another class is; 1 if none is less. It matters
    if a forest names a class that agrees less than another."""
    lost: bool = True
    """Whether the pose is no good."""
    scale: float = 1.0
    """How many times larger the part is than its file: a vertex x of the file lies at
    R · (scale · x) + t in the scan, with R and t of ``pose``."""
    beyond: bool = False
    """Whether the parts of the class differ from its CAD by more than the tolerance."""
    span: float = 1.0
    """Diameter of the scan in those of the part."""
    vague: bool = False
    """Whether the pose says nothing: residual or noise is a large share of the part, or the scan a
    small one."""
    eye: Float[np.ndarray, "3"] | None = None
    """Place of the camera in the axes of the scan: the known one, or the likeliest."""

    @property
    def disagreement(self) -> float:
        """The misfit times the noises that the scan is off; infinite if beyond or vague.

        The noise of a cloud without a surface is as large as the cloud, which agrees with any CAD.
        The scan of a known part lies on the CAD even if much of the CAD is hidden. A pose disagrees
        more by the square of how many times better another class agrees.
        """
        off = self.misfit * self.off / self.noise * self.beaten**_BY
        return np.inf if self.beyond or self.vague else off

    @property
    def is_scrap(self) -> bool:
        """Whether the scan may be a scrap, which agrees with this CAD by accident."""
        return self.span < _LONG

    @property
    def agreement(self) -> float:
        """Rank of a CAD file: minus the logarithms of the misfit, twice, and of the residual.

        The misfit counts noises, and the residual metres; how rare the view is counts as well. The
        misfit alone separates the CAD files of simulated scans nearly as well
        (`qs3.parts.forest_and_cad` weighs all three for a run).
        """
        misfit = max(self.misfit, LEAST_MISFIT)
        off = 2 * np.log(misfit) + np.log(max(self.residual, LEAST_RESIDUAL))
        return -float(off + _RARE * self.surprise)


@dataclass(frozen=True)
class Location:
    """Answer for one scan."""

    candidates: tuple[Candidate, ...]
    """One for each CAD file that can hold the scan, best first."""

    @property
    def best(self) -> Candidate | None:
        """The best candidate; None if every CAD file is far smaller than the scan."""
        return self.candidates[0] if self.candidates else None

    @property
    def lost(self) -> bool:
        """Whether no pose of any part is good."""
        return self.best is None or self.best.lost

    @property
    def pose(self) -> Float[np.ndarray, "4 4"] | None:
        """Pose of the best candidate, see `Candidate.pose`; None if the scan is lost."""
        return None if self.best is None or self.lost else self.best.pose


def locate(
    library: Library,
    points: Shaped[np.ndarray, "..."],
    place: Place = NOWHERE,
) -> Location:
    """Find the part in a scan in metres: class, CAD file and pose.

    Args:
        library: The CAD.
        points: The scan, [n 3].
        place: What is known of its place.

    Raises:
        InputError: For another shape, fewer than 12 distinct points, points that are not finite, a
            scan in another unit, and a camera below the table or over 1 km away.
    """
    check_kind("locate", library, Library)
    return located(compare(library, scan_of(points, place), place))


def scan_of(points: Shaped[np.ndarray, "..."], place: Place) -> Scan:
    """Return a scan ready for `compare`; raises as `locate` does."""
    if not isinstance(place, Place):
        raise InputError(f"place {place!r}: give a qs3.parts.Place")
    if place.on_table and place.camera is not None and place.camera[2] <= 0:
        raise InputError(
            f"the camera is {0 - place.camera[2]:.3f} m below the table; the scan needs z up and "
            "the table at z = 0"
        )
    return prepare(points, None if place.camera is None else np.array(place.camera))


def compare(library: Library, scan: Scan, place: Place) -> list[Candidate]:
    """Return the best pose of each CAD file that can hold a scan; `located` judges them."""
    largest = library.largest
    if scan.diameter > _TOO_LARGE * largest:
        raise InputError(
            f"the scan is {scan.diameter:.3g} m across and the largest CAD {largest:.3g} m; the "
            "scan must be in metres (divide millimetres by 1000), and the CAD needs its unit"
        )
    # Compiled code would take the place of a camera far away for an index of a pixel.
    if scan.eye is not None and (away := float(np.linalg.norm(scan.eye))) > _FARTHEST:
        raise InputError(
            f"the camera is {away:,.0f} m from the scan; give its place in the axes of the scan's "
            "file, in metres"
        )
    table, noise = -float(scan.centre[2]) if place.on_table else None, noise_of(scan)
    reach, tried = scan.diameter, []
    if table is not None:  # it is known how far an end is from the table
        reach = max(reach, float(np.quantile(scan.points[:, 2], 0.95)) - table)
    for part in library:
        if scan.diameter > _PARTLY * part.diameter:
            continue
        starts = first_poses(scan, part, table)
        found = [refine(scan, part, start, table, noise) for start in starts[:_FIRST]]
        tried.append((part, starts[_FIRST:], max(found, key=_agreement)))
    tried.sort(key=lambda row: -_agreement(row[2]))
    candidates = []
    for rank, (part, starts, best) in enumerate(tried):
        if rank < _NEAR and -_agreement(best) < _MARGIN - _RIVAL * _agreement(tried[0][2]):
            begun = [begin(scan, part, start, table) for start in starts]
            begun.sort(key=lambda start: start.cost)
            found = [refine(scan, part, start, table, noise) for start in begun[:_LATER]]
            best = max([best, *found], key=_agreement)
        candidates.append(_candidate(part, best, scan, noise, reach))
    return candidates


def located(candidates: Iterable[Candidate]) -> Location:
    """Return the candidates of all compared CAD files: in order, and judged beside each other.

    Unless the scan may be a scrap, a disagreement counts less by a power of how many times less the
    misfit is than that of every other CAD file: a known part agrees far better with its own,
    however noisy the camera. A run knows the camera, and judges by the disagreement alone.
    """
    ranked = sorted(candidates, key=lambda candidate: -candidate.agreement)
    least = sorted(candidate.misfit for candidate in ranked)[:2]
    judged = []
    for candidate in ranked:
        others = least[1:] if candidate.misfit == least[0] else least[:1]
        clear = 1.0
        if not candidate.is_scrap:
            clear = max(1.0, min([_CLEAR, *(other / candidate.misfit for other in others)]))
        rivals = [other.misfit for other in ranked if other.class_name != candidate.class_name]
        rival = max(min(rivals, default=np.inf), LEAST_MISFIT)
        candidate = replace(candidate, beaten=max(1.0, candidate.misfit / rival))
        lost = candidate.disagreement / clear**_BY > _LOST or candidate.visible < _SHOWN
        judged.append(replace(candidate, lost=lost))
    return Location(tuple(judged))


def _agreement(found: Found) -> float:
    return found.score.log_likelihood + found.prior


def _candidate(part: Part, found: Found, scan: Scan, noise: float, reach: float) -> Candidate:
    way = found.turn.T @ (found.eye - found.shift) - part.middle
    odds = part.odds(way / np.linalg.norm(way))
    pose = rigid(found.turn, found.shift + scan.centre)
    agreed = found.score
    vague = max(agreed.residual, noise) > _VAGUE * part.diameter or reach < _END * part.diameter
    return Candidate(
        part.class_name, part.cad, part.symmetry.canonical(pose), part.symmetry,
        agreed.residual, agreed.off, agreed.visible, agreed.explained,
        noise, max(agreed.misfit - found.prior, _POSITIVE), -float(np.log(odds)),
        scale=part.times, beyond=part.beyond, span=scan.diameter / part.diameter,
        eye=found.eye + scan.centre, vague=vague,
    )  # fmt: skip
