"""Files whose size or up axis differs from that of the others: a wrong unit, a part on its side."""

import contextlib
from collections.abc import Iterable, Sequence
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Float

from qs3.errors import InputError, say_once
from qs3.meshes.poses import PoseName, resting_poses
from qs3.meshes.sizes import Unit, file_unit

_LEAST, _MOST = 1e-3, 5.0
"""Metres from which to which a part or a piece of furniture is long."""
_FACTORS = {25.4: ("mm and inches", 1.26), 1000.0: ("mm and metres", 2.5)}
"""Ratio of two units, their names, and the factor by which a ratio of sizes may be off."""
_SPREAD, _ALIKE, _CLEARLY = 10.0, 1.3, 1.2
_LIKELY, _MOST_OF = 0.15, 0.75
_LISTED = 5


class Measured(NamedTuple):
    """The box of a mesh."""

    id: str
    class_name: str
    extents: Float[np.ndarray, "3"]
    """Metres along x, y and z; z is up."""

    @property
    def size(self) -> float:
        """The longest side."""
        return float(self.extents.max())


def odd_sizes(measured: Sequence[Measured]) -> list[tuple[str, str]]:
    """Compare files with the others of their class, or with all if each file is a class.

    Returns:
        For each fault the id of the file, or of the smallest of its class, and a line.
    """
    groups: dict[str, list[Measured]] = {}
    for one in measured:
        groups.setdefault(one.class_name, []).append(one)
    are_classes = all(len(group) == 1 for group in groups.values())
    found: dict[str, str] = {}
    for group in [list(measured)] if are_classes else groups.values():
        whose = "all files" if are_classes else f"class {group[0].class_name}"
        for one in group:
            text = _odd_size(one, group, whose)
            if not text and not are_classes:
                text = _on_its_side(one, [other for other in group if other is not one], whose)
            if text:
                found[one.id] = f"{one.id}: {text}"
    lines = list(found.items())
    for name, group in groups.items():
        sound = sorted((one for one in group if one.id not in found), key=lambda one: one.size)
        if len(sound) > 1 and sound[-1].size > _SPREAD * sound[0].size:
            low, high = sound[0], sound[-1]
            sizes = f"{low.id} is {low.size:.3g} m long and {high.id} {high.size:.3g} m"
            lines.append((low.id, f"class {name}: {sizes}: are their units right?"))
    return lines


def _odd_size(one: Measured, group: Sequence[Measured], whose: str) -> str:
    median = sorted(each.size for each in group)[(len(group) - 1) // 2]
    ratio = max(one.size / median, median / one.size)
    for factor, (units, band) in _FACTORS.items():
        if factor / band < ratio < factor * band:
            return (
                f"is {one.size:.3g} m long, and the median of {whose} is {median:.3g} m, a ratio "
                f"of {ratio:.3g}: are {units} mixed up? Give its unit in the CSV of --labels, "
                "column unit"
            )
    if _LEAST <= one.size <= _MOST:
        return ""
    return f"is {one.size:.3g} m long, outside 1 mm to 5 m: is its unit right (--units)?"


def _on_its_side(one: Measured, others: Sequence[Measured], whose: str) -> str:
    """Report a file of the proportions of the others, whose height is another side than theirs."""
    if len(others) < 2:
        return ""
    sides = np.sort([other.extents / other.size for other in others], axis=1)
    own = np.sort(one.extents / one.size)
    ratio = own / np.median(sides, axis=0).clip(1e-9)
    if not (ratio < _ALIKE).all() or not (ratio > 1 / _ALIKE).all():
        return ""
    sides, own = np.stack([other.extents for other in others]), one.extents
    tall = np.mean(sides[:, 2] > _CLEARLY * sides[:, :2].max(axis=1))
    flat = np.mean(sides[:, 2] * _CLEARLY < sides[:, :2].min(axis=1))
    lies = own[2] * _CLEARLY < own[:2].max()
    stands = own[2] > _CLEARLY * own[:2].min()
    for share, is_odd, text in ((tall, lies, "stand"), (flat, stands, "lie flat")):
        if share >= _MOST_OF and is_odd:
            return (
                f"has another side upwards than the others of {whose}, which {text}: is another "
                "axis up? Give it in the CSV of --labels, column up"
            )
    return ""


def check_files(items: Iterable[Any], units: Unit | None, pose: PoseName) -> None:
    """Warn of odd sizes before a scan of meshes in the sizes of their files.

    Warns also if parts that lie in several stable poses would be scanned upright. A mesh that
    cannot be used is left to its scan.
    """
    measured: list[Measured] = []
    guesses: dict[str, str] = {}
    has_warned = pose != "upright"
    for item in items:
        if getattr(item, "path", None) is None:
            continue
        with contextlib.suppress(InputError):
            mesh = item.load()
            metres, title = file_unit(mesh, units)
            is_first = item.class_name not in {one.class_name for one in measured}
            measured.append(Measured(item.id, item.class_name, np.asarray(mesh.extents) * metres))
            if title.endswith("(guessed)"):
                guesses.setdefault(title.split()[0], item.id)
            if is_first and not has_warned:
                has_warned = _warn_of_poses(item.class_name, mesh)
        if len(guesses) > 1:
            raise InputError(
                f"object_size file: {guesses['m']} would be taken for metres and {guesses['mm']} "
                "for millimetres, by their lengths; if all have one unit, name it: --units mm, "
                "say; if not, give the unit of each in the CSV of --labels, column unit"
            )
    texts = [text for _, text in odd_sizes(measured)]
    more = [f"{len(texts) - _LISTED} more warnings of sizes: see qs3 meshes"]
    for text in texts[:_LISTED] + more * (len(texts) > _LISTED):
        say_once(text)


def _warn_of_poses(class_name: str, mesh: Any) -> bool:
    likely = sum(pose.probability > _LIKELY for pose in resting_poses(mesh))
    if likely > 1:
        say_once(
            f"class {class_name}: has {likely} likely resting poses and is scanned upright alone; "
            "--pose resting draws them",
            kind="several resting poses",
        )
    return likely > 1
