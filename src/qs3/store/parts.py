"""Scans on their way into a shard: one small file each, so that no finished scan is ever lost.

The process that scans an object writes its row, or the reason of its failure, into ``.parts``
beside the shards. When all rows of a shard have come, they are put together, the shard is written
and its parts are removed. Every step can be repeated: whatever a power cut leaves behind leads to
the same bytes.
"""

import json
import re
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import pyarrow as pa

from qs3.errors import InputError
from qs3.files import parse_json
from qs3.store.executors import Failure, guarded
from qs3.store.executors.executor import failure_of
from qs3.store.folder import PARTS, Folder
from qs3.store.manifest import shard_name
from qs3.store.shards import DType, load_shard, parse_shard, put_shard, shard_bytes, table_of

_PART = re.compile(rf"{re.escape(PARTS)}/(\d+)/(\d+)\.(parquet|json)")


class Place(NamedTuple):
    """Where a row belongs."""

    shard: int
    """Index of the shard."""
    row: int
    """Index of the row within the shard, failed ones counted."""

    @property
    def stem(self) -> str:
        """Name of the part without its ending."""
        return f"{part_folder(self.shard)}/{self.row:06d}"


def part_folder(shard: int) -> str:
    """Return the sub-folder of the parts of a shard."""
    return f"{PARTS}/{shard:05d}"


def written_parts(folder: Folder, shard: int | None = None) -> dict[Place, str]:
    """Return the names of all parts, or of those of a shard, by place; of two, the row's."""
    parts: dict[Place, str] = {}
    for name in folder.names(PARTS if shard is None else part_folder(shard)):
        match = _PART.fullmatch(name)
        if match and (match[3] == "parquet" or Place(int(match[1]), int(match[2])) not in parts):
            parts[Place(int(match[1]), int(match[2]))] = name
    return parts


def scan_to_part(
    folder: Folder, place: Place, dtype: DType, scan: Callable[[], Any]
) -> Failure | None:
    """Make one row and write it, or the reason why there is none, as a part.

    Returns:
        The failure, or None where the row is written. A part that cannot be written is a fatal
        failure: it lies with the machine, not with the object.
    """
    row = guarded(scan)
    try:
        if not isinstance(row, Failure):
            folder.write(f"{place.stem}.parquet", shard_bytes(table_of([row], dtype)))
            return None
        if not row.fatal:
            write_failure(folder, place, row)
        return row
    except Exception as error:
        failure = failure_of(error)
        reason = failure.reason
        if not isinstance(error, InputError):  # which names the file and what to do
            reason = f"{folder}: cannot be written to ({reason}); mend that and run the same "
            reason += "command again, nothing is lost"
        return Failure(failure.kind, reason, fatal=True)


def write_failure(folder: Folder, place: Place, failure: Failure) -> None:
    """Write why a row is missing as a part."""
    record = {"error": failure.kind, "reason": failure.reason}
    folder.write(f"{place.stem}.json", json.dumps(record, ensure_ascii=False).encode("utf-8"))


def read_failure(folder: Folder, name: str) -> Failure:
    """Read why a row is missing.

    Raises:
        InputError: where the part is damaged.
    """
    record = parse_json(folder.read(name), f"{folder}/{name}")
    try:
        return Failure(str(record["error"]), str(record["reason"]))
    except (KeyError, TypeError) as error:
        raise InputError(f"{folder}/{name}: damaged; delete it and run the same again") from error


def finish_shard(
    folder: Folder, shard: int, dtype: DType, order: Sequence[str], failed: Sequence[str]
) -> str:
    """Put the parts of a shard together, with the rows that the shard has already.

    ``order`` has the ids of all its rows, ``failed`` those that will be absent.

    Returns:
        SHA-256 of the shard, in hexadecimal.

    Raises:
        InputError: where a part or the shard that is there is damaged, or a row is neither there
            nor among the failed.
    """
    tables = [table_of([], dtype)]
    name = shard_name(shard)
    if folder.exists(name):
        tables.append(load_shard(folder, shard))
    parts = [part for part in written_parts(folder, shard).values() if part.endswith(".parquet")]
    for part, content in folder.read_many(parts).items():
        tables.append(parse_shard(content, f"{folder}/{part}"))
    table = pa.concat_tables(tables)
    # A row may be in both where an earlier call was stopped here: they are the same.
    position = {identifier: row for row, identifier in enumerate(table["id"].to_pylist())}
    lost = [i for i in order if i not in position and i not in failed]
    if lost:
        raise InputError(
            f"{folder}/{name}: {len(lost)} scans that were made are not there, such as {lost[0]}; "
            "do all processes see one and the same folder? Mend that and run the same command again"
        )
    rows = pa.array([position[i] for i in order if i in position], pa.int64())
    return put_shard(folder, shard, table.take(rows))
