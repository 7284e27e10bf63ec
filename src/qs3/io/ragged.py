"""Clouds as they come out of files: of any sizes, with or without labels."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from jaxtyping import Int

from qs3.errors import InputError
from qs3.io.clouds import Origin, PointClouds, UnlabelledClouds, digests, numbered
from qs3.io.preparation import stack
from qs3.meshes.classes import ClassMap, label_order, map_labels, rename, require_named


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
        class_map: ClassMap | None = None,
        origin: Origin = Origin("arrays"),  # noqa: B008
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
            InputError: where there are no labels, a class is not in ``class_names`` or cannot be
                called as ``class_map`` wants it, or sizes differ and no size is asked for.
        """
        if self.labels is None:
            raise InputError(f"{where}: has no labels, and this needs them")
        own = list(self.class_names)
        present = np.unique(self.labels).tolist()
        try:
            if class_map is not None:
                if class_names is None:
                    require_named(own, class_map)
                for row, name in zip(
                    present, rename([own[row] for row in present], class_map), strict=True
                ):
                    own[row] = name
            listed = own if class_map is None else [own[row] for row in present]
            names = label_order(listed) if class_names is None else tuple(class_names)
            labels, _ = map_labels(own, self.labels, names)
        except InputError as error:
            raise InputError(f"{where}: {error}") from error
        called = dict(zip(self.labels.tolist(), labels.tolist(), strict=True))
        renamed = {self.class_names[row]: names[called[row]] for row in present}
        renamed = {name: other for name, other in renamed.items() if name != other}
        points = stack(self.clouds, num_points, where, most)
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
        return UnlabelledClouds(points[order], numbered(len(points)), self.checksum)


def relabel(
    clouds: PointClouds, class_names: Sequence[str] | None, class_map: ClassMap | None, where: str
) -> PointClouds:
    """Return labelled clouds under other names of their classes; see `RaggedClouds.labelled`."""
    given = RaggedClouds(
        list(clouds.points), clouds.ids, clouds.checksum, clouds.labels, clouds.class_names
    )
    origin = clouds.origin or Origin("arrays")
    return given.labelled(None, class_names, where, None, class_map, origin)
