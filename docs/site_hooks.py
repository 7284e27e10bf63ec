"""Hooks of mkdocs: pages made from files outside ``docs/``, and the options of every command.

- ``contributing.md``, ``changelog.md`` and ``examples.md`` are made when the site is built, and
  links to those files lead to these pages.
- ``<!-- options: VERB -->`` in a page becomes the table of that verb's options, as ``--help`` tells
  them, and ``<!-- package: NAME -->`` the description of a package, so that neither falls behind.
- A page that would load something from the network stops the build.
"""

import contextlib
import io
import os
import re
from pathlib import Path
from typing import Any

import site_api

_ROOT = Path(__file__).parent.parent
_COPIED = {"CONTRIBUTING.md": "contributing.md", "CHANGELOG.md": "changelog.md"}
_OPTIONS = re.compile(r"^<!-- options: ([a-z ]+) -->$", re.MULTILINE)
_PACKAGE = re.compile(r"^<!-- package: ([a-z0-9.]+) -->$", re.MULTILINE)
_FETCHED = re.compile(
    r"<(?:script|link|img|iframe|source|video|audio|embed|object)\b[^>]*?"
    r"\b(?:src|href|srcset|data)=[\"']?((?:https?:)?//[^\"'\s>]+)"
)
_OUTWARD = re.compile(r"\]\((?:\.\./)+(CONTRIBUTING\.md|CHANGELOG\.md|examples(?:/[\w.]*)?)\)")


def on_files(files: Any, config: Any) -> Any:
    """Add the pages that are made from files elsewhere."""
    from mkdocs.structure.files import File

    for name, page in _COPIED.items():
        text = (_ROOT / name).read_text(encoding="utf-8").replace("](docs/", "](")
        files.append(File.generated(config, page, content=text))
    files.append(File.generated(config, "examples.md", content=examples()))
    return files


def on_page_markdown(markdown: str, page: Any, config: Any, files: Any) -> str:
    """Fill in what is made at the build, and turn links out of ``docs/`` to pages of the site."""
    up = "../" * page.file.src_uri.count("/")

    def inward(match: re.Match[str]) -> str:
        return f"]({up}{_COPIED.get(match[1], 'examples.md')})"

    markdown = _OUTWARD.sub(inward, markdown)
    markdown = _PACKAGE.sub(lambda match: site_api.body(match[1]), markdown)
    return _OPTIONS.sub(lambda match: options_table(match[1].split()), markdown)


def on_post_page(output: str, page: Any, config: Any) -> str:
    """Refuse a page that would load anything from the network."""
    if found := fetched(output):
        raise ValueError(f"{page.file.src_uri} loads {', '.join(found)}")
    return output


def fetched(html: str) -> list[str]:
    """Addresses from which a page would load scripts, styles, fonts, pictures or frames."""
    return [match[1] for match in _FETCHED.finditer(html)]


def examples() -> str:
    """The page that shows every example whole."""
    parts = ["# Examples\n\nThe tests of every change run these files; so does `make examples`.\n"]
    for path in sorted((_ROOT / "examples").glob("*.py")):
        code = path.read_text(encoding="utf-8")
        title = path.stem.partition("_")[2].replace("_", " ").capitalize()
        parts.append(f"## {title}\n\n`python examples/{path.name}`\n\n```python\n{code}```\n")
    return "\n".join(parts)


def help_of(words: list[str]) -> str:
    """What ``qs3 WORDS --help`` prints, its groups of options one below the other."""
    from qs3.cli import main

    out = io.StringIO()
    before = os.environ.get("COLUMNS")
    os.environ["COLUMNS"] = "129"  # from 130 on, tyro puts groups side by side
    try:
        with contextlib.redirect_stdout(out), contextlib.suppress(SystemExit):
            main([*words, "--help"])
    finally:
        if before is None:
            del os.environ["COLUMNS"]
        else:
            os.environ["COLUMNS"] = before
    return out.getvalue()


def options_of(text: str) -> list[tuple[str, str]]:
    """Read a help text: each argument or option with its value, and what it means."""
    found: list[tuple[str, str]] = []
    inside = False
    for line in text.splitlines():
        words = line.strip()
        if set(words) == {"-"}:
            inside = True
        elif not words:
            inside = False
        elif inside and re.match(r"  \S", line):
            flag, _, meaning = words.partition("  ")
            found.append((flag, meaning.strip()))
        elif inside and found:
            found[-1] = (found[-1][0], f"{found[-1][1]} {words}".strip())
    return [row for row in found if not row[0].startswith(("-h", "(required)", "•"))]


def options_table(words: list[str]) -> str:
    """The options of a verb as a folded table."""
    rows = [
        f"| `{_cell(flag)}` | {_cell(meaning, escape=True)} |"
        for flag, meaning in options_of(help_of(words))
    ]
    if not rows:
        raise ValueError(f"qs3 {' '.join(words)} --help tells no option")
    lines = ["| option | meaning |", "|---|---|", *rows]
    title = f"Options of {' '.join(words)}"
    return "\n".join([f'??? info "{title}"', "", *(f"    {line}" for line in lines)])


def _cell(text: str, escape: bool = False) -> str:
    text = text.replace("{None}|", "").replace("|", r"\|")
    if not escape:
        return text
    # Between backticks Markdown reads nothing.
    parts = text.split("`")
    parts[::2] = [re.sub(r"([<>*_\[\]])", r"\\\1", part) for part in parts[::2]]
    return "`".join(parts)
