"""The log of scans that failed: ``failures.jsonl`` beside the shards, one record a line."""

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from qs3.errors import InputError
from qs3.files import parse_json
from qs3.store.folder import Folder, open_folder

FAILURES = "failures.jsonl"


def write_failures(folder: Folder, records: Iterable[Mapping[str, Any]]) -> None:
    """Write the log anew, whole, in the order of shards and rows; an empty one is removed."""
    ordered = sorted(records, key=lambda record: (record["shard"], record["row"], record["id"]))
    if not ordered:
        if folder.exists(FAILURES):
            folder.remove(FAILURES)
        return
    # ASCII alone: some of Unicode's signs end a line in the eyes of some readers.
    lines = [json.dumps(record) + "\n" for record in ordered]
    folder.write(FAILURES, "".join(lines).encode("ascii"))


def read_failures(where: str | Path | Folder) -> list[dict[str, Any]]:
    """Return the objects that could not be scanned, one record each, in the order of the ids.

    A record has ``id``, ``object``, ``scan``, ``class_name``, ``shard``, ``row`` (in its shard),
    ``error`` and ``reason``.

    Raises:
        InputError: where the log is damaged.
    """
    folder = open_folder(where)
    if not folder.exists(FAILURES):
        return []
    try:
        lines = folder.read(FAILURES).removesuffix(b"\n").split(b"\n")
        records = [parse_json(line, f"line {n}") for n, line in enumerate(lines, start=1)]
        # Logs of earlier versions have no row.
        records = [record | {"row": int(record.get("row", 0))} for record in records]
        return sorted(records, key=lambda record: record["id"])
    except (KeyError, TypeError, ValueError) as error:
        raise InputError(
            f"{folder}/{FAILURES}: damaged ({error}); delete it and run the same command again "
            "with --retry-failed"
        ) from error
