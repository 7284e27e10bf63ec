"""Hooks of mkdocs: pages made from code and from files outside ``docs/``.

- ``contributing.md``, ``changelog.md`` and ``examples.md`` are made when the site is built, and
  links to those files lead to these pages.
- ``<!-- options: VERB -->`` in a page becomes the table of that verb's options, from ``--help``.
- ``<!-- settings: CLASS -->`` becomes the table of a dataclass: fields, defaults, docstrings.
- ``<!-- presets: scans -->`` and ``<!-- presets: rounds -->`` become the tables of the presets.
- ``<!-- package: NAME -->`` becomes the description of a package: the public names that its
  ``__init__.py`` exports (``from x import Y as Y``), and its public modules. Code is read, not
  imported.
- A page that would load something from the network stops the build.
- mkdocstrings expects ``Examples:`` in docstrings; `Examples` lets it read ``Example:``, too.
"""

import ast
import contextlib
import dataclasses
import functools
import importlib
import importlib.util
import io
import itertools
import os
import re
from pathlib import Path
from typing import Any

_ROOT = Path(__file__).parent.parent
_SOURCE = _ROOT / "src"
_COPIED = {"CONTRIBUTING.md": "contributing.md", "CHANGELOG.md": "changelog.md"}
_OPTIONS = re.compile(r"^<!-- options: ([a-z ]+) -->$", re.MULTILINE)
_SETTINGS = re.compile(r"^<!-- settings: ([\w.]+) -->$", re.MULTILINE)
_PRESETS = re.compile(r"^<!-- presets: (scans|rounds) -->$", re.MULTILINE)
_PACKAGE = re.compile(r"^<!-- package: ([a-z0-9.]+) -->$", re.MULTILINE)
_FETCHED = re.compile(
    r"<(?:script|link|img|iframe|source|video|audio|embed|object)\b[^>]*?"
    r"\b(?:src|href|srcset|data)=[\"']?((?:https?:)?//[^\"'\s>]+)"
)
_OUTWARD = re.compile(r"\]\((?:\.\./)+(CONTRIBUTING\.md|CHANGELOG\.md|examples(?:/[\w.]*)?)\)")
_ONE_EXAMPLE = re.compile(r"^(\s*)Example:$", re.MULTILINE)
PACKAGES = (
    "qs3",
    "qs3.shapes",
    "qs3.meshes",
    "qs3.sensor",
    "qs3.store",
    "qs3.points",
    "qs3.frames",
    "qs3.clouds",
    "qs3.objects",
    "qs3.evaluation",
    "qs3.models",
    "qs3.adaptation",
    "qs3.runs",
    "qs3.training",
    "qs3.parts",
    "qs3.answers",
    "qs3.workflow",
    "qs3.report",
    "qs3.paper",
)
_ROOT_MODULES = (
    "qs3.errors",
    "qs3.geometry",
    "qs3.files",
    "qs3.lazy",
    "qs3.reading",
    "qs3.processors",
    "qs3.structure",
    "qs3.toml_files",
    "qs3.checks",
)
_DEFINITIONS = (ast.FunctionDef, ast.ClassDef)


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
    markdown = _PACKAGE.sub(lambda match: body(match[1]), markdown)
    markdown = _SETTINGS.sub(lambda match: settings_table(match[1]), markdown)
    markdown = _PRESETS.sub(lambda match: presets_table(match[1]), markdown)
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
        raise ValueError(f"qs3 {' '.join(words)} --help prints no option")
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


def settings_table(name: str) -> str:
    """Return the documented fields of a dataclass as a table."""
    module, _, own = name.rpartition(".")
    kind = getattr(importlib.import_module(module), own)
    lines = ["| setting | default | meaning |", "|---|---|---|"]
    for field in dataclasses.fields(kind):
        base = next(part for part in kind.__mro__ if field.name in vars(part).get(_OWN, ()))
        text = _field_text(base, field.name)
        if base.__name__ != "Method" and text:
            default = field.default_factory() if field.default is _MISSING else field.default
            lines.append(f"| `{field.name}` | {_value(default)} | {_cell(text, escape=True)} |")
    return "\n".join(lines)


def presets_table(which: str) -> str:
    """Return the settings in which the presets of scans or of rounds differ as a table."""
    from qs3.runs.settings import PRESETS, preparation_of
    from qs3.sensor.stage.settings import PRESETS as SCANS

    if which == "rounds":
        columns = {name: dataclasses.asdict(preset) for name, preset in PRESETS.items()}
    else:
        columns = {
            name: {**scan, **dataclasses.asdict(preparation_of(name))}
            for name, scan in SCANS.items()
        }
    lines = [f"| setting | {' | '.join(f'`{name}`' for name in columns)} |"]
    lines.append("|---" * (len(columns) + 1) + "|")
    for name in columns["default"]:
        values = [_value(column[name]) for column in columns.values()]
        if len({*values}) > 1:
            lines.append(f"| `{name}` | {' | '.join(values)} |")
    return "\n".join(lines)


_OWN, _MISSING = "__annotations__", dataclasses.MISSING


def _value(value: Any) -> str:
    if isinstance(value, bool):
        return "on" if value else "off"
    return "–" if value is None else f"{value}"


def _field_text(kind: type, name: str) -> str:
    """Return the docstring below a field of a class."""
    [own] = (
        node for node in _tree(kind.__module__).body if getattr(node, "name", "") == kind.__name__
    )
    for node, after in itertools.pairwise(own.body):  # type: ignore[attr-defined]
        match node, after:
            case ast.AnnAssign(target=ast.Name(id=found)), ast.Expr(ast.Constant(str(words))):
                if found == name:
                    return " ".join(words.replace("``", "`").split())
    return ""


def handed_on(module: str) -> dict[str, str]:
    """Names that a module hands on, and the module that each comes from."""
    return {
        alias.name: node.module
        for node in ast.walk(_tree(module))
        if isinstance(node, ast.ImportFrom) and node.module
        for alias in node.names
        if alias.asname == alias.name
    }


def public_modules(package: str) -> list[str]:
    """Modules of a package, those of its packages among them, without private ones."""
    if package == "qs3":
        return list(_ROOT_MODULES)
    found = []
    for path in sorted(_folder(package).rglob("*.py")):
        parts = path.relative_to(_SOURCE).with_suffix("").parts
        parts = parts[:-1] if parts[-1] == "__init__" else parts
        if not any(part.startswith("_") for part in parts) and ".".join(parts) != package:
            found.append(".".join(parts))
    return found


def body(package: str) -> str:
    """The names of a package, and the directives for its modules, as Markdown."""
    rows = []
    for name, module in sorted(handed_on(package).items(), key=lambda pair: pair[0].lower()):
        rows.append(f"| {_link(package, module, name)} | `{module}` |")
    parts = []
    if rows:
        table = "\n".join(["| name | from |", "|---|---|", *rows])
        parts = ["## Public names", f"`from {package} import …`", table]
    modules = [f"::: {module}" for module in public_modules(package) if _tells(module)]
    if modules:
        parts += ["## Modules", *modules]
    return "\n\n".join(parts)


def _link(package: str, module: str, name: str) -> str:
    """A name, with a link to its description followed through modules that only hand it on."""
    while handed_on(module).get(name, module) != module:  # a package may hand on its own module
        module = handed_on(module)[name]
    if not _describes(module, name):
        return f"`{name}`"
    home = max((p for p in PACKAGES if module.startswith(f"{p}.")), key=len)
    where = "" if home == package else f"{home.removeprefix('qs3.')}.md"
    return f"[`{name}`]({where}#{module}.{name})"


def _describes(module: str, name: str) -> bool:
    """Whether a module defines a name and says what it is."""
    body = _tree(module).body
    for index, node in enumerate(body):
        if isinstance(node, _DEFINITIONS) and node.name == name:
            return ast.get_docstring(node) is not None
        targets = [node.target] if isinstance(node, ast.AnnAssign) else getattr(node, "targets", [])
        if any(isinstance(target, ast.Name) and target.id == name for target in targets):
            after = body[index + 1] if index + 1 < len(body) else None
            return isinstance(after, ast.Expr) and isinstance(after.value, ast.Constant)
    return False


def _tells(module: str) -> bool:
    """Whether a module defines anything public."""
    return any(
        isinstance(node, _DEFINITIONS) and not node.name.startswith("_")
        for node in _tree(module).body
    )


def _folder(module: str) -> Path:
    return _SOURCE.joinpath(*module.split("."))


@functools.cache
def _tree(module: str) -> ast.Module:
    folder = _folder(module)
    path = folder / "__init__.py" if folder.is_dir() else folder.with_suffix(".py")
    return ast.parse(path.read_text(encoding="utf-8"))


if importlib.util.find_spec("griffe"):  # it comes with mkdocstrings, and the tests need none
    import griffe

    class Examples(griffe.Extension):
        """Turn the heading of a single example into the one that is read as code."""

        def on_object(self, *, obj: griffe.Object, **_: Any) -> None:
            """Look at every module, class, function and attribute."""
            if obj.docstring is not None:
                obj.docstring.value = _ONE_EXAMPLE.sub(r"\1Examples:", obj.docstring.value)
