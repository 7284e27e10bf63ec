"""``qs3 info``: the contents of a data set."""

import json
from typing import Annotated, Any

import tyro

from qs3.cli.text import show, tell
from qs3.errors import InputError


def info(
    folder: Annotated[str, tyro.conf.Positional], as_json: bool = False, check: bool = False
) -> int:
    """Print what a data set holds: counts, sizes, statistics of the sensor, failures.

    Args:
        folder: Folder of a data set, or clouds in any layout that qs3 train reads.
        as_json: Print everything, settings and versions too, as one JSON object.
        check: Read every shard and print its faults: damage, labels, repeated ids, clouds that are
            empty or not finite, missing rows.
    """
    from qs3.io.load import describe_clouds, is_store
    from qs3.store.failures import read_failures
    from qs3.store.info import check as find_faults
    from qs3.store.info import info as count

    if check:
        faults = find_faults(folder)
        show(*faults)
        if faults:
            raise InputError(f"{folder}: {len(faults)} faults, printed above")
    if not is_store(folder):
        clouds = describe_clouds(folder)
        show(*([json.dumps(clouds, indent=2)] if as_json else _cloud_lines(clouds)))
        return 0
    contents = count(folder)
    failures = read_failures(folder)
    if as_json:
        show(json.dumps({**contents, "failures": failures}, indent=2))
        return 0
    show(*_lines(contents))
    show(*(f"  {record['id']}: {record['reason']}" for record in failures[:5]))
    if len(failures) > 5:
        show(f"  and {len(failures) - 5} more in failures.jsonl")
    if contents["shards"] < contents["shards_planned"]:
        tell(f"unfinished: run the same command again to go on with {folder}")
    return 0


def _cloud_lines(contents: dict[str, Any]) -> list[str]:
    lines = [
        f"{contents['rows']} clouds, read as {contents['layout']}",
        f"{' to '.join(map(str, dict.fromkeys(contents['points'])))} points a cloud",
    ]
    parts = ((name, contents[name]) for name in ("classes", "splits"))
    return [*lines, *(f"{name}: {_counts(counts)}" for name, counts in parts if counts)]


def _lines(contents: dict[str, Any]) -> list[str]:
    from qs3.store.shards import STATISTICS

    planned = "" if contents["rows_planned"] is None else f" of {contents['rows_planned']} planned"
    points = " to ".join(str(size) for size in dict.fromkeys(contents["points"])) or "no"
    lines = [
        f"{contents['rows']} clouds{planned}, of {contents['objects']} objects",
        f"{contents['shards']} of {contents['shards_planned']} shards, "
        f"{contents['bytes'] / 1e6:.1f} MB",
        f"{points} points a cloud",
        "classes: " + _counts(contents["classes"]),
    ]
    if empty := [name for name, count in contents["classes"].items() if not count]:
        lines.append("no cloud of: " + ", ".join(empty))
    if contents["renamed"]:
        names = (f"{own} → {other}" for own, other in contents["renamed"].items())
        lines.append("renamed: " + ", ".join(names))
    if any(contents["splits"]):
        lines.append("splits: " + _counts(contents["splits"]))
    for name, value in contents["statistics"].items():
        label, form = STATISTICS[name]
        lines.append(f"{label} (median): {value:{form}}")
    sensor = contents["settings"].get("sensor")
    sensors = [preset for preset in (sensor if isinstance(sensor, list) else [sensor]) if preset]
    if sensors and all(isinstance(preset, dict) and "name" in preset for preset in sensors):
        lines.append("sensor: " + ", ".join(str(preset["name"]) for preset in sensors))
    return [*lines, f"failed: {contents['failed']}"]


def _counts(counts: dict[str, int]) -> str:
    return ", ".join(f"{name or '(none)'} {count}" for name, count in counts.items() if count)
