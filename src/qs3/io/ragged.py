"""Clouds as they come out of files: of any sizes, with or without labels."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Int

from qs3.errors import InputError
from qs3.io.clouds import Origin, PointClouds, UnlabelledClouds, digests, numbered
from qs3.io.guards import naming
from qs3.io.preparation import stack
from qs3.io.scratch import scratch_array
from qs3.meshes.classes import label_order, map_labels, require_named


@dataclass(frozen=True)
class RaggedClouds:
    """Clouds of different sizes."""

    clouds: Sequence[Any]
    """Arrays of shape [n 3], one a cloud."""
    ids: tuple[str, ...]
    """One name a cloud."""
    checksum: str
    """SHA-256 over what was read."""
    labels: Int[np.ndarray, "b"] | None = None
    """Index into ``class_names``, where the files tell."""
    class_names: tuple[str, ...] = ()
    """Names as the files have them."""
    splits: tuple[str, ...] = ()
    """Split of each cloud (``train``, ``test`` or empty), where the files tell."""

    def labelled(
        self,
        num_points: int | None,
        class_names: Sequence[str] | None,
        where: str,
        most: int | None = None,
        class_map: Mapping[str, str] | None = None,
        origin: Origin | None = None,
    ) -> PointClouds:
        """Return clouds of one size with labels that index ``class_names``.

        Args:
            num_points: Points a cloud; None keeps what is there.
            class_names: Classes of the result, found by name or alias; None takes the files' own,
                see `label_order`.
            where: What was read, for messages.
            most: As in `qs3.io.preparation.stack`.
            class_map: What the files' classes shall be called before that; None keeps their names.
            origin: Where the clouds are from; what is called otherwise is added.

        Raises:
            InputError: where there are no labels, a class is not in ``class_names``, ``class_map``
                is of no class, or sizes differ and no size is asked for.
        """
        if self.labels is None:
            raise InputError(f"{where}: has no labels, and this needs them")
        called = [(class_map or {}).get(name, name) for name in self.class_names]
        names = label_order(called) if class_names is None else tuple(class_names)
        with naming(where):
            if class_map is not None and class_names is None:
                require_named(self.class_names, class_map)
            labels, _ = map_labels(called, self.labels, names)
        pairs = sorted(set(zip(self.labels.tolist(), labels.tolist(), strict=True)))
        new_names = {self.class_names[row]: names[label] for row, label in pairs}
        renamed = {name: other for name, other in new_names.items() if name != other}
        points = stack(self.clouds, num_points, where, most)
        origin = origin or Origin("arrays")
        origin = replace(origin, renamed={**origin.renamed, **renamed})
        return PointClouds(points, labels, names, self.ids, self.checksum, origin)

    def unlabelled(
        self, num_points: int | None, where: str, most: int | None = None
    ) -> UnlabelledClouds:
        """Return clouds of one size without labels, and with numbers for names.

        Names of files and objects often tell the class; not even they go along. Nor does the order
        of the files, which folders of classes sort by class: clouds come in that of their
        points' checksums.

        Raises:
            InputError: where there is no cloud, or sizes differ and no size is asked for.
        """
        points = stack(self.clouds, num_points, where, most)
        order = np.argsort(digests(points), kind="stable")
        ordered = np.take(points, order, axis=0, out=scratch_array(points.shape))
        return UnlabelledClouds(ordered, numbered(len(points)), self.checksum)


def relabel(
    clouds: PointClouds, class_names: Sequence[str], class_map: Mapping[str, str] | None, where: str
) -> PointClouds:
    """Return labelled clouds under other names of their classes; see `RaggedClouds.labelled`."""
    given = RaggedClouds(
        list(clouds.points), clouds.ids, clouds.checksum, clouds.labels, clouds.class_names
    )
    return given.labelled(None, class_names, where, None, class_map, clouds.origin)
