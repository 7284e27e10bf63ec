"""Answers of a run that all scans have a say in: the scale of parts, and how calm the camera is."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from qs3.answers.answer import Answer, answer, compared, refused
from qs3.answers.cloud_files import ListedCloud
from qs3.checks import check_tolerance
from qs3.errors import InputError
from qs3.parts.places import NOWHERE, Place
from qs3.reading import fault_of
from qs3.runs.loaded import Loaded
from qs3.store.bars import compared_bar

if TYPE_CHECKING:
    from qs3.parts.deviation import Deviation, Look
    from qs3.parts.library import Library
    from qs3.parts.witness import Known, Witness


def answer_within(
    model: Loaded,
    clouds: Sequence[ListedCloud],
    tolerance: float,
    *,
    unknown: float | None = None,
    calibrated: bool = False,
    name: str | Path = "this network",
    camera: bool = False,
) -> "tuple[list[Answer], Witness, dict[str, Deviation]]":
    """Answer clouds whose parts may be larger or smaller than their CAD.

    Every class has one scale over all clouds (`qs3.parts.deviation.settle`). What the run knows of
    scales does not count: the answers are those by its CAD if the tolerance is 0.

    Args:
        model: The forest of a run with CAD.
        clouds: As for `qs3.answers.answer.answer`, as are the other arguments.
        tolerance: Share by which parts may be larger or smaller than their CAD.
        unknown: See there.
        calibrated: See there.
        name: See there.
        camera: Whether the clouds show how calm their camera is
            (`qs3.parts.forest_and_cad.Fusion.of_scans`); else the run's limits count.

    Returns:
        The answers; the CAD at the scale of the parts, with limits for the camera; and how each
        class differs from its CAD.

    Raises:
        InputError: If the run has no CAD, or the tolerance is out of range.
    """
    from qs3.parts.deviation import Look, settle  # it imports numba
    from qs3.parts.locating import scan_of

    check_tolerance(tolerance)
    witness = model.witness
    if witness is None:
        raise InputError(f"{name}: a tolerance needs a run with CAD (qs3 train --meshes)")
    options = {"unknown": unknown, "calibrated": calibrated, "pose": False, "name": name}
    plain = [*answer(model, clouds, **options)]
    answers: list[Answer] = []

    def answer_all(witness: "Witness", known: "Sequence[Known]") -> None:
        pairs = zip(compared_bar(plain, len(plain)), known, strict=True)
        answers[:] = [refused(_fused(*pair, witness), unknown) for pair in pairs]

    def looks(library: "Library") -> "list[Look]":
        nonlocal witness
        witness, seen = replace(witness, library=library), []
        if camera:
            witness = witness.of_scans([])
        known: list[Known] = [{} for _ in plain]
        answer_all(witness, known)
        if camera:
            before = witness.fusion, witness.placed
            witness = witness.of_scans(map(_judged, answers))
            if (witness.fusion, witness.placed) != before:
                answer_all(witness, known)
        for fused in answers if tolerance else ():
            if fused.candidates and fused.points is not None and fused.place is not None:
                scan = scan_of(fused.points, fused.place)
                # The likeliest class has the scan, as forest and CAD say together.
                ranks = {kind: rank for rank, kind in enumerate(fused.probabilities)}
                found = sorted(fused.candidates, key=lambda found: ranks[found.class_name])
                seen.append(Look(scan, fused.place, tuple(found)))
        return seen

    found = settle(witness.library, looks, tolerance)[1]
    return answers, witness, found


def _judged(answer: Answer) -> tuple[Place, str, float]:
    """Return what `Witness.of_scans` asks of a scan; one without a pose agrees with nothing."""
    if answer.found is None or answer.place is None:
        return NOWHERE, "", np.inf
    return answer.place, answer.found.class_name, answer.found.disagreement


def _fused(answer: Answer, known: "Known", witness: "Witness") -> Answer:
    try:
        return answer if answer.fault else compared(answer, witness, known)
    except InputError as error:
        return Answer(answer.file, fault=fault_of(answer.file, error))
