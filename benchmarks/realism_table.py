"""The table of docs/realism.md from records of `qs3 realism`: a row a figure, a column a record.

    for sensor in d415 d435 d455 kinect-v1; do qs3 realism --sensor $sensor --out out/$sensor; done
    python benchmarks/realism_table.py out/d415 out/d435 out/d455 out/kinect-v1

It fills in the page between its markers, and leaves the rest as it is.
"""

import argparse
import re
from pathlib import Path
from typing import Any

from qs3.files import read_json, write_text
from qs3.sensor.realism import LAWS

PAGE = Path(__file__).resolve().parent.parent / "docs" / "realism.md"
UNBOUNDED = ("autocorrelation", "locking")
Record = dict[str, Any]


def put(name: str, text: str) -> None:
    """Put ``text`` between the page's markers of that name."""
    begin, end = f"<!-- {name}: begin -->", f"<!-- {name}: end -->"
    page = PAGE.read_text(encoding="utf-8")
    before, _, rest = page.partition(begin)
    _, found, after = rest.partition(end)
    if not found:
        raise SystemExit(f"{PAGE.name}: no markers {begin} … {end}")
    write_text(PAGE, f"{before}{begin}\n{text.strip()}\n{end}{after}")
    print(f"{PAGE.name}: wrote {name}")


def family(what: str) -> str:
    """A figure's name without the place it was taken at: rows of one family share a line."""
    return re.sub(r" (at [\d.]+ (m|px)|\(.*\)|to [\d.]+ m)$", "", what)


def shown(result: Record) -> dict[str, list[Record]]:
    """A test's figures that have bounds, and some of those that have none, by family."""
    found: dict[str, list[Record]] = {}
    for one in result["rows"]:
        if one["passed"] is not None or one["what"].startswith(UNBOUNDED):
            found.setdefault(family(one["what"]), []).append(one)
    return found


def figures(rows: list[Record], bounds: bool) -> str:
    """Measured values of a family, misses in bold, with their bounds if asked."""
    words = []
    for one in rows:
        text = "–" if one["measured"] is None else f"{one['measured']:.4g}"
        text = text if one["passed"] is not False else f"**{text}**"
        words.append(f"{text} ({one['expected']})" if bounds and one["expected"] else text)
    return ", ".join(words)


def realism_table(records: list[Record]) -> str:
    """One row a figure, one column a record."""
    names = " | ".join(f"`{record['sensor']['name']}`" for record in records)
    lines = [f"| test | figure | bounds | {names} |", "|" + "---|" * (len(records) + 3)]
    for test in LAWS:
        results = [next((t for t in r["tests"] if t["id"] == test), None) for r in records]
        seen = [shown(result) if result else {} for result in results]
        for name in dict.fromkeys(name for one in seen for name in one):
            there = [row for one in seen for row in one.get(name, [])]
            bounds = {row["expected"] for row in there}
            same = bounds.pop() if len(bounds) == 1 else ""
            unit = there[0]["unit"] or ""
            cells = [figures(one[name], not same) if name in one else "–" for one in seen]
            figure = name.replace("|", "\\|") + (f", {unit}" if unit else "")
            lines.append(f"| {test} | {figure} | {same or ''} | {' | '.join(cells)} |")
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folders", nargs="+", type=Path, help="of qs3 realism, one a column")
    folders = parser.parse_args().folders
    put("tests", realism_table([read_json(folder / "realism.json") for folder in folders]))


if __name__ == "__main__":
    main()
