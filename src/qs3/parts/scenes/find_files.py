"""Answers of `qs3 find` for frames: JSON, CSV, and the results of the BOP toolkit."""

import re
import time
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float

from qs3.errors import InputError, StorageError, say_once
from qs3.escapes import csv_text, json_text, utf8
from qs3.frames.images import DEPTH_FILES, find_mask, read_mask
from qs3.geometry import is_rotation
from qs3.objects.coco import CocoMasks
from qs3.parts.library import UNEXPLAINED, Library
from qs3.parts.pose_values import symmetry_values
from qs3.parts.scenes.finding import find
from qs3.parts.scenes.found import FindSettings, FoundPart, FoundParts
from qs3.parts.scenes.frames import FramePath, read_frame
from qs3.reading import naming, plain_text, reading


@dataclass(frozen=True)
class FrameAnswer:
    """The parts of one frame, or its fault."""

    frame: FramePath
    found: FoundParts | None = None
    seconds: float = 0.0
    fault: str = ""


def find_in_frames(
    library: Library,
    frames: Iterable[FramePath],
    settings: FindSettings = FindSettings(),  # noqa: B008
    masks: Path | CocoMasks | None = None,
) -> Iterator[FrameAnswer]:
    """Find the parts in each frame; one that cannot be read has a fault.

    So has one that shows neither a table nor a part. ``masks`` is a folder of instance
    masks with the names of the frames, 0 for background, or those of a JSON of COCO.
    """
    for frame in frames:
        start = time.perf_counter()
        try:
            with naming(frame.path):
                depth, camera = read_frame(frame)
                numbers = None
                if isinstance(masks, CocoMasks):
                    rows, columns = depth.shape
                    numbers = masks.of(_place(masks, frame), (rows, columns))
                elif masks is not None:
                    numbers = read_mask(_place(masks, frame), depth.shape, True)
                found = find(library, depth, camera, settings, numbers)
            yield FrameAnswer(frame, found, time.perf_counter() - start)
        except StorageError:
            raise
        except InputError as error:
            yield FrameAnswer(frame, fault=str(error))
        except OSError as error:
            yield FrameAnswer(frame, fault=f"{error.filename or frame.path}: {error.strerror}")


def _place(masks: Path | CocoMasks, frame: FramePath) -> Any:
    """Return what holds the masks of a frame: a file, or a key of a JSON of COCO."""
    if isinstance(masks, CocoMasks):
        return masks.place(frame.path, frame.scene_id, frame.im_id)
    return find_mask(masks, frame.path)


def check_masks(masks: Path | CocoMasks, frames: Sequence[FramePath]) -> None:
    """Refuse masks of no frame, or of two; report masks in a JSON that are of no frame."""
    where, owners = masks.path if isinstance(masks, CocoMasks) else masks, {}
    for frame in frames:
        try:
            place = _place(masks, frame)
        except InputError:
            continue  # the fault of this frame alone
        if (other := owners.setdefault(place, frame)) is not frame:
            raise InputError(
                f"{where}: {other.path} and {frame.path} have the same masks; search them one by "
                "one, each with its own"
            )
    if isinstance(masks, Path):
        if not any(place.is_file() for place in owners):
            names = ", ".join(DEPTH_FILES)
            raise InputError(f"{where}: no mask has the name of a frame; masks are {names}")
        return
    if strange := [str(number) for _, number in masks.masks.keys() - owners.keys()]:
        fault = f"{where}: image {min(strange, key=int)} has masks and is no frame"
        if len(strange) > 1:
            fault += f", nor are {len(strange) - 1} others"
        if len(strange) == len(masks.masks):
            raise InputError(f"{fault}; an image_id is the number in a frame's name")
        say_once(fault)


def answers_json(
    answers: Iterable[FrameAnswer], base: Float[np.ndarray, "4 4"] | None = None
) -> str:
    """Return a JSON list of frames with their parts and what is unexplained; lengths in metres.

    ``base`` is the pose base from camera: each part then also has ``base_from_part``.
    """
    rows = [answer_record(answer, base) for answer in answers]
    return json_text(rows)


def answer_record(
    answer: FrameAnswer, base: Float[np.ndarray, "4 4"] | None = None
) -> dict[str, Any]:
    """Return a frame's parts as plain values."""
    row: dict[str, Any] = {"frame": utf8(answer.frame.name), "file": utf8(str(answer.frame.path))}
    row |= {"scene_id": answer.frame.scene_id, "im_id": answer.frame.im_id}
    if answer.found is None:
        return row | {"fault": answer.fault}
    rest = [asdict(one) for one in answer.found.unexplained]
    parts = [part_record(part, base) for part in answer.found.parts]
    way = answer.found.camera_from_table
    way = None if way is None else way.tolist()
    return row | {"seconds": answer.seconds, "camera_from_table": way, "parts": parts,
                  UNEXPLAINED: rest}  # fmt: skip


def part_record(part: FoundPart, base: Float[np.ndarray, "4 4"] | None = None) -> dict[str, Any]:
    """Return a part as plain values."""
    row: dict[str, Any] = {
        "class": part.class_name, "cad": part.cad, "score": part.score, "pose": part.pose.tolist(),
    }  # fmt: skip
    row |= {} if part.scale == 1 else {"scale": part.scale}
    if base is not None:
        row["base_from_part"] = (base @ part.pose).tolist()
    return row | {"residual": part.residual, "visible": part.visible, "points": part.points,
                  "symmetry": symmetry_values(part.symmetry)}  # fmt: skip


def answers_csv(
    answers: Iterable[FrameAnswer], base: Float[np.ndarray, "4 4"] | None = None
) -> str:
    """Return a CSV with one row per part, per rest that is unexplained, and per fault.

    The pose is camera from part, or with ``base`` base from part: r11 to r33 are the rotation by
    rows, x, y and z the shift in metres. Of what is unexplained x, y and z are the middle. There is
    a column ``scale`` if parts differ from their CAD, see `FoundPart`.
    """
    turns, shifts = [f"r{i}{j}" for i in (1, 2, 3) for j in (1, 2, 3)], ["x", "y", "z"]
    heads = ["frame", "class", "cad", "score", "residual_mm", "visible", "points", *shifts, *turns,
             "file", "fault"]  # fmt: skip
    first = np.eye(4) if base is None else base
    rows: list[dict[str, Any]] = []
    answers = list(answers)
    every = [part for answer in answers if answer.found is not None for part in answer.found.parts]
    scaled = any(part.scale != 1 for part in every)
    heads[-2:-2] = ["scale"] if scaled else []
    for answer in answers:
        head = {"frame": utf8(answer.frame.name), "file": utf8(str(answer.frame.path))}
        if answer.found is None:
            rows.append({**head, "fault": utf8(answer.fault)})
            continue
        for part in answer.found.parts:
            pose = first @ part.pose
            rows.append({
                **head, "class": part.class_name, "cad": part.cad,
                "score": f"{part.score:.4f}", "residual_mm": f"{1000 * part.residual:.3f}",
                "visible": f"{part.visible:.4f}", "points": part.points,
                **_cells(shifts, pose[:3, 3]), **_cells(turns, pose[:3, :3]),
                **({"scale": f"{part.scale:g}"} if scaled else {}),
            })  # fmt: skip
        for rest in answer.found.unexplained:
            middle = first[:3, :3] @ np.array(rest.centre) + first[:3, 3]
            rows.append({**head, "class": UNEXPLAINED, "points": rest.points,
                         **_cells(shifts, middle)})  # fmt: skip
    return csv_text(heads, rows)


def _cells(names: list[str], values: np.ndarray) -> dict[str, str]:
    return {name: f"{value:.8f}" for name, value in zip(names, values.ravel(), strict=True)}


def _numbers(values: np.ndarray, scale: float = 1.0) -> str:
    return " ".join(f"{scale * value:.8f}" for value in np.asarray(values).ravel())


def answers_bop(answers: Iterable[FrameAnswer], library: Library) -> str:
    """Return the results CSV of the BOP toolkit: t in millimetres, ``time`` in seconds per picture.

    Source: https://github.com/thodan/bop_toolkit, ``inout.save_bop_results``.
    """
    numbers = object_numbers(library)
    if library.scales:
        say_once("results for the BOP toolkit have no scale: poses are those of the scaled CAD")
    lines = ["scene_id,im_id,obj_id,score,R,t,time"]
    for answer in answers:
        for part in () if answer.found is None else answer.found.parts:
            frame = answer.frame
            cells = [frame.scene_id, frame.im_id, numbers[part.cad], f"{part.score:.6f}",
                     _numbers(part.pose[:3, :3]), _numbers(part.pose[:3, 3], 1000.0),
                     f"{answer.seconds:.6f}"]  # fmt: skip
            lines.append(",".join(map(str, cells)))
    return "\n".join(lines) + "\n"


def object_numbers(library: Library) -> dict[str, int]:
    """Return the number of each CAD file: that of ``obj_000005``, else its place from 1 on."""
    cads = [part.cad for part in library]
    matches = [re.search(r"(?:^|/)obj_(\d+)$", cad) for cad in cads]
    if all(matches):
        return {cad: int(match[1]) for cad, match in zip(cads, matches, strict=True) if match}
    return {cad: k for k, cad in enumerate(cads, start=1)}


def read_base(path: Path) -> Float[np.ndarray, "4 4"]:
    """Read the pose base from camera: a text file of 4×4 numbers by rows, in metres."""
    with naming(path), reading(path, "a text file of 4×4 numbers"):
        text = re.sub("#.*", "", plain_text(path.read_bytes()).decode())
        numbers = [float(word) for word in re.sub(r"[,;\[\]()]", " ", text).split()]
        if len(numbers) != 16:
            raise InputError(f"holds {len(numbers)} numbers; a pose has 4×4, by rows")
        pose = np.array(numbers).reshape(4, 4)
        if not is_rotation(pose[:3, :3], 1e-3):
            raise InputError("its upper left 3×3 numbers are no rotation; write the pose by rows")
        if not np.allclose(pose[3], (0, 0, 0, 1)):
            raise InputError("its last row is not 0 0 0 1; write the pose by rows")
        if not np.abs(pose[:3, 3]).max() <= 50:
            raise InputError("its shift is NaN or beyond 50 m; write it in metres")
    return pose
