"""What a page of docs/api holds: the public names of a package, and all of its public modules.

A package's public names are those that its ``__init__.py`` hands on (``from x import Y as Y``);
each is described by the module that holds it. Code is read, not imported.
"""

import ast
import functools
from pathlib import Path

_SOURCE = Path(__file__).parent.parent / "src"
PACKAGES = (
    "qs3",
    "qs3.shapes",
    "qs3.meshes",
    "qs3.sensor",
    "qs3.store",
    "qs3.io",
    "qs3.evaluation",
    "qs3.models",
    "qs3.adaptation",
    "qs3.training",
    "qs3.report",
    "qs3.viewer",
    "qs3.experiments",
)
_ROOT_MODULES = (
    "qs3.errors",
    "qs3.geometry",
    "qs3.files",
    "qs3.lazy",
    "qs3.processors",
    "qs3.structure",
    "qs3.toml_files",
)
_DEFINITIONS = (ast.FunctionDef, ast.ClassDef)


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
    where = "" if home == package or module in _ROOT_MODULES else f"{home.removeprefix('qs3.')}.md"
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
