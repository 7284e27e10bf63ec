"""Clouds as they come out of files: of any sizes, with or without labels."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from jaxtyping import Int

from qs3.errors import InputError
from qs3.io.clouds import PointClouds, UnlabelledClouds, digests, numbered
from qs3.io.preparation import stack
from qs3.io.scratch import scratch_array
from qs3.meshes.classes import POINTDA10, map_labels


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
    ) -> PointClouds:
        """Return clouds of one size with labels that index ``class_names``.

        Args:
            num_points: Points a cloud; None keeps what is there.
            class_names: Classes of the result; None takes PointDA-10's ten where every class maps
                onto them, else the files' own.
            where: What was read, for messages.
            most: As in `qs3.io.preparation.stack`.

        Raises:
            InputError: where there are no labels, a class is not in ``class_names``, or sizes
                differ and no size is asked for.
        """
        if self.labels is None:
            raise InputError(f"{where}: has no labels, and this needs them")
        try:
            names = POINTDA10 if class_names is None else tuple(class_names)
            labels, _ = map_labels(self.class_names, self.labels, names)
        except InputError as error:
            if class_names is not None:
                raise InputError(f"{where}: {error}") from error
            names, labels = self.class_names, self.labels.astype(np.int64)
        points = stack(self.clouds, num_points, where, most)
        return PointClouds(points, labels, names, self.ids, self.checksum)

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
