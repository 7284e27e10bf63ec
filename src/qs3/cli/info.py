"""``qs3 info``: the contents of a data set."""

import json
from typing import Annotated, Any

import tyro

from qs3.cli.text import notify, show
from qs3.errors import InputError


def info(
    folder: Annotated[str, tyro.conf.Positional],
    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False,
    check: bool = False,
) -> int:
    """Print what a data set holds: counts, sizes, statistics of the sensor, failures.

    Args:
        folder: Folder of a data set, or clouds in any layout that qs3 train reads.
        as_json: Print everything, settings and versions too, as one JSON object.
        check: Read every shard and print its faults: damage, labels, repeated ids, clouds that are
            empty or not finite, missing rows.
    """
    from qs3.clouds.load import describe_clouds, is_store
    from qs3.store.info import check as find_faults
    from qs3.store.info import info as count
    from qs3.store.manifest import read_failures

    if check:
        faults = find_faults(folder)
        show(*faults)
        if faults:
            raise InputError(f"{folder}: {len(faults)} faults, printed above")
    contents = count(folder) if is_store(folder) else describe_clouds(folder)
    failures = read_failures(folder)
    if as_json:
        show(json.dumps(contents | ({"failures": failures} if is_store(folder) else {}), indent=2))
        return 0
    show(*_lines(contents))
    show(*(f"  {record['id']}: {record['reason']}" for record in failures[:5]))
    if len(failures) > 5:
        show(f"  and {len(failures) - 5} more in failures.jsonl")
    if contents.get("shards", 0) < contents.get("shards_planned", 0):
        notify(f"unfinished: run the same command again to go on with {folder}")
    return 0


def _lines(contents: dict[str, Any]) -> list[str]:
    from qs3.store.shards import STATISTICS

    planned = contents.get("rows_planned")
    lines = [f"{contents['rows']} clouds" + ("" if planned is None else f" of {planned} planned")]
    if "layout" in contents:
        lines[0] += f", read as {contents['layout']}"
    else:
        lines[0] += f", of {contents['objects']} objects"
        size = f"{contents['bytes'] / 1e6:.1f} MB"
        lines.append(f"{contents['shards']} of {contents['shards_planned']} shards, {size}")
    sizes = " to ".join(str(size) for size in dict.fromkeys(contents["points"])) or "no"
    lines.append(f"{sizes} points per cloud")
    for name in ("classes", "splits"):
        counts = {key or "(none)": count for key, count in contents[name].items()}
        if counts and [*counts] != ["(none)"]:
            lines.append(f"{name}: " + ", ".join(f"{key} {n}" for key, n in counts.items()))
    if renamed := contents.get("renamed"):
        lines.append("renamed: " + ", ".join(f"{old} → {new}" for old, new in renamed.items()))
    for name, value in contents.get("statistics", {}).items():
        label, form = STATISTICS[name]
        lines.append(f"{label} (median): {value:{form}}")
    sensor = contents.get("settings", {}).get("sensor")
    presets = [preset for preset in (sensor if isinstance(sensor, list) else [sensor]) if preset]
    if presets:
        lines.append("sensor: " + ", ".join(str(preset["name"]) for preset in presets))
    return [*lines, f"failed: {contents['failed']}"] if "failed" in contents else lines
