"""The log of scans that failed: ``failures.jsonl`` beside the shards, one record a line."""

import json
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from qs3.errors import InputError
from qs3.files import parse_json, write_text

FAILURES = "failures.jsonl"


def write_failures(folder: Path, records: Iterable[Mapping[str, Any]]) -> None:
    """Replace the log, in the order of shards and rows; remove it if there are no records."""
    ordered = sorted(records, key=lambda record: (record["shard"], record["row"], record["id"]))
    if ordered:
        write_text(folder / FAILURES, "".join(json.dumps(record) + "\n" for record in ordered))
    else:
        (folder / FAILURES).unlink(missing_ok=True)


def read_failures(folder: str | Path) -> list[dict[str, Any]]:
    """Return the records of the scans that failed, in the order of their ids."""
    path = Path(folder) / FAILURES
    if not path.is_file():
        return []
    try:
        records = [parse_json(line, path) for line in path.read_text("utf-8").splitlines()]
        return sorted(records, key=lambda record: record["id"])
    except (KeyError, TypeError, ValueError) as error:
        fix = "delete it and run the same command again with --retry-failed"
        raise InputError(f"{path}: damaged ({error}); {fix}") from error


def refuse_failures(folder: str | Path, what: str) -> None:
    """Raise an error that names the first failure, if there are any."""
    if failures := read_failures(folder):
        raise InputError(
            f"{folder}/{FAILURES}: {len(failures)} {what} failed; the first: {failures[0]['id']}: "
            f"{failures[0]['reason']}; all others are there, --retry-failed does these again"
        )
