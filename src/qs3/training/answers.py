"""What a run says of files: the class of each, how sure it is, which others come near."""

import csv
import glob
import io
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

from qs3.errors import InputError
from qs3.files import json_bytes, new_folder
from qs3.io.guards import utf8
from qs3.io.layouts.point_folders import check_class
from qs3.io.point_files import POINT_FILES, read_cloud
from qs3.training.checkpoint import load_model
from qs3.training.predict import predict_probabilities
from qs3.training.prepared import note_size


@dataclass(frozen=True)
class Answer:
    """What the network says of one file."""

    file: Path
    """The file."""
    probabilities: Mapping[str, float] = field(default_factory=dict)
    """Of every class, the likeliest first; empty where the file cannot be read."""
    fault: str = ""
    """Why it cannot be read."""

    def best(self, count: int = 1) -> list[tuple[str, float]]:
        """Return the likeliest classes and their probabilities."""
        return list(self.probabilities.items())[:count]


def list_clouds(given: Sequence[Path]) -> list[Path]:
    """List files of points: files as they are named, folders with all below them, patterns.

    Raises:
        InputError: where a folder or a pattern has none.
    """
    files: list[Path] = []
    for path in given:
        if path.is_dir():
            paths = [p for p in sorted(path.rglob("*")) if p.suffix.lower() in POINT_FILES]
            paths = [p for p in paths if p.is_file() and p.name[0] != "."]
        elif path.exists() or not glob.has_magic(str(path)):
            paths = [path]
        else:
            matches = glob.glob(str(path), recursive=True)  # noqa: PTH207 (takes absolute ones too)
            paths = [Path(name) for name in sorted(matches)]
        if not paths:
            raise InputError(f"{path}: no cloud found; known are {', '.join(POINT_FILES)}")
        files += paths
    return list(dict.fromkeys(files))


def predict_files(run: Path, files: Iterable[Path]) -> Iterator[Answer]:
    """Tell the class of each file, one after another; one that cannot be read has a fault.

    Args:
        run: Folder of a run, its model.safetensors, or the name of a network that comes with qs3.
        files: Files of points, z up.

    Raises:
        InputError: where the run cannot be read.
    """
    loaded = load_model(run)
    for path in files:
        try:
            points = read_cloud(path)[None]
            note_size(points, loaded.preparation)
            shares = predict_probabilities(loaded, points)[0].tolist()
        except InputError as error:
            text = str(error)
            yield Answer(path, fault=text if str(path) in text else f"{path}: {text}")
            continue
        named = zip(loaded.class_names, shares, strict=True)
        yield Answer(path, dict(sorted(named, key=lambda item: -item[1])))


def answers_csv(answers: Iterable[Answer], top: int = 1) -> str:
    """A table: file, class, confidence, the next of ``top`` classes, and the fault if any."""
    more = [f"{word}_{i}" for i in range(2, top + 1) for word in ("class", "confidence")]
    buffer = io.StringIO()
    rows = csv.DictWriter(buffer, ["file", "class", "confidence", *more, "fault"])
    rows.writeheader()
    for answer in answers:
        row = {"file": utf8(str(answer.file)), "fault": answer.fault}
        for i, (name, share) in enumerate(answer.best(top), start=1):
            ending = "" if i == 1 else f"_{i}"
            row |= {f"class{ending}": name, f"confidence{ending}": f"{share:.6f}"}
        rows.writerow(row)
    return buffer.getvalue()


def answers_json(answers: Iterable[Answer]) -> str:
    """A list of objects: file, class, confidence and the probability of every class; or a fault."""
    rows = []
    for answer in answers:
        row: dict[str, object] = {"file": utf8(str(answer.file))}
        for name, share in answer.best():
            row |= {"class": name, "confidence": share, "probabilities": answer.probabilities}
        rows.append(row | ({"fault": answer.fault} if answer.fault else {}))
    return json_bytes(rows).decode()


def sort_into(folder: Path, answers: Iterable[Answer]) -> None:
    """Link files into a folder of each class, for a person to put right and to train on.

    Args:
        folder: A new or empty folder; it becomes ``<class>/<file>``, links to the files.
        answers: What is sorted; files that could not be read are left out.

    Raises:
        InputError: where the folder is taken, or a class cannot name a folder.
    """
    with new_folder(folder) as whole:
        whole.mkdir()
        for answer in answers:
            for name, _ in answer.best():
                check_class(name)
                own = whole / name
                own.mkdir(exist_ok=True)
                link, number = own / answer.file.name, 1
                while link.is_symlink():
                    number += 1
                    link = own / f"{answer.file.stem}-{number}{answer.file.suffix}"
                link.symlink_to(answer.file.resolve())
