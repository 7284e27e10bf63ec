"""Bring the pages of the methods up to date with docs/adaptation.md and docs/settings.md.

A page says in its own words what a method does; its formula, its settings and how it differs from
the publication stand between markers and are copied from the section on the method (`formula`,
`settings`, `differs`), or from the settings of self-training that a rule reads (`rounds`).

Usage: ``python docs/make_method_pages.py`` (from the repository)
"""

import re
from pathlib import Path

_DOCS = Path(__file__).parent
_BLOCK = re.compile(r"(<!-- (\w+) of ([a-z0-9-]+) -->\n).*?(<!-- end -->)", re.DOTALL)
_OTHER_RULES = {
    "qbst": {"rule", "prior", "quantile", "portion", "portion_step"},
    "spst": {"rule", "prior", "quantile", "portion", "portion_step", "selection", "single_class"},
}
"""Settings of self-training that a rule does not read."""


def section(name: str) -> str:
    """The text on a method in docs/adaptation.md."""
    page = (_DOCS / "adaptation.md").read_text(encoding="utf-8")
    for part in re.split(r"^#{2,3} ", page, flags=re.MULTILINE):
        title, _, text = part.partition("\n")
        if f"`{name}`" in title:
            return text.strip().replace("](", "](../")
    raise ValueError(f"docs/adaptation.md has no section on {name}")


def formula(name: str) -> str:
    """The paragraphs before commands, settings and differences."""
    kept = []
    for paragraph in section(name).split("\n\n"):
        if paragraph.startswith(("```", "|", "Differs")):
            break
        kept.append(paragraph)
    return "\n\n".join(kept)


def settings(name: str) -> str:
    """The table of settings."""
    return "\n".join(line for line in section(name).splitlines() if line.startswith("|"))


def differs(name: str) -> str:
    """What is not as published."""
    text = section(name)
    return text[re.search(r"^Differs", text, re.MULTILINE).start() :]  # type: ignore[union-attr]


def rounds(rule: str) -> str:
    """The settings of self-training that a rule reads, with its defaults."""
    page = (_DOCS / "settings.md").read_text(encoding="utf-8")
    table = page.split("### Self-training")[1].split("\n### ")[0]
    rows = [line for line in table.splitlines() if line.startswith("| `")]
    lines = ["| setting | default | what it does |", "|---|---|---|"]
    for row in rows:
        name, default, spst, meaning = (cell.strip() for cell in row.strip("|").split("|"))
        if name.strip("`") not in _OTHER_RULES[rule]:
            lines.append(f"| {name} | {spst if rule == 'spst' else default} | {meaning} |")
    return "\n".join(lines)


_MAKE = {"formula": formula, "settings": settings, "differs": differs, "rounds": rounds}


def filled(page: str) -> str:
    """A page with everything between its markers made anew."""
    return _BLOCK.sub(lambda m: f"{m[1]}{_MAKE[m[2]](m[3])}\n{m[4]}", page)


if __name__ == "__main__":
    for path in sorted((_DOCS / "methods").glob("*.md")):
        path.write_text(filled(path.read_text(encoding="utf-8")), encoding="utf-8")
