"""The log of scans that failed: ``failures.jsonl`` beside the shards, one record a line."""

import json
from collections.abc import Mapping, Set
from pathlib import Path
from typing import Any

from qs3.errors import InputError
from qs3.files import write_text

FAILURES = "failures.jsonl"


def log_failure(folder: Path, record: Mapping[str, Any]) -> None:
    """Append one record; ``id`` and ``shard`` are needed to read and to forget it."""
    with (folder / FAILURES).open("a", encoding="utf-8") as handle:
        handle.write(json.dumps(record, ensure_ascii=False) + "\n")


def forget_failures(folder: Path, shards: Set[int]) -> None:
    """Drop the failures of shards that are scanned again, and a line that was cut off."""
    path = folder / FAILURES
    if not path.is_file():
        return
    kept = []
    for line in path.read_text(encoding="utf-8", errors="replace").splitlines():
        try:
            if json.loads(line)["shard"] not in shards:
                kept.append(line + "\n")
        except (json.JSONDecodeError, KeyError, TypeError):
            continue
    write_text(path, "".join(kept))


def read_failures(folder: Path) -> list[dict[str, Any]]:
    """Return the objects that could not be scanned, one record each, in the order of the ids.

    Raises:
        InputError: where the log is damaged.
    """
    path = Path(folder) / FAILURES
    if not path.is_file():
        return []
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
        return sorted((json.loads(line) for line in lines), key=lambda record: record["id"])
    except (UnicodeDecodeError, json.JSONDecodeError, KeyError, TypeError) as error:
        raise InputError(f"{path}: damaged ({error}); delete it") from error
