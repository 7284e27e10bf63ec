"""How large the house is: lines of code, docstrings, comments and blanks, by room.

    python benchmarks/lines.py                    # this tree
    python benchmarks/lines.py --root ../older    # another one beside it

Counts come from the syntax tree: a docstring is a string that opens a module, class or function, or
stands alone under a field; code is every other line that holds a token which is no comment.
"""

import argparse
import ast
import io
import tokenize
from collections import Counter
from pathlib import Path

LONG = 300
KINDS = ("code", "docstrings", "comments", "blank")
_NO_CODE = (
    tokenize.COMMENT,
    tokenize.NL,
    tokenize.NEWLINE,
    tokenize.INDENT,
    tokenize.DEDENT,
    tokenize.ENDMARKER,
    tokenize.ENCODING,
)


def count(text: str) -> Counter[str]:
    """Return the lines of a file by kind."""
    lines = text.splitlines()
    documented: set[int] = set()
    for node in ast.walk(ast.parse(text)):
        if (
            isinstance(node, ast.Expr)
            and isinstance(node.value, ast.Constant)
            and isinstance(node.value.value, str)
        ):
            documented |= set(range(node.lineno, (node.end_lineno or node.lineno) + 1))
    held: set[int] = set()
    for token in tokenize.generate_tokens(io.StringIO(text).readline):
        if token.type not in _NO_CODE:
            held |= set(range(token.start[0], token.end[0] + 1))
    code = held - documented
    blank = {n for n, line in enumerate(lines, 1) if not line.strip()} - held - documented
    return Counter(
        code=len(code),
        docstrings=len(documented),
        blank=len(blank),
        comments=len(lines) - len(code) - len(documented) - len(blank),
        lines=len(lines),
        files=1,
    )


def rooms(folder: Path) -> dict[str, Counter[str]]:
    """Return the lines of every folder directly below one, and of the files beside them."""
    found: dict[str, Counter[str]] = {}
    for path in sorted(folder.rglob("*.py")):
        parts = path.relative_to(folder).parts
        room = parts[0] if len(parts) > 1 else "(files)"
        found.setdefault(room, Counter()).update(count(path.read_text(encoding="utf-8")))
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--root", type=Path, default=Path(__file__).parents[1])
    root = parser.parse_args().root
    for name, folder in (("src", root / "src" / "qs3"), ("tests", root / "tests")):
        by_room = rooms(folder)
        total = sum(by_room.values(), Counter())
        print(f"{name:<14}{'files':>7}{'lines':>8}" + "".join(f"{kind:>12}" for kind in KINDS))
        for room, lines in [*by_room.items(), ("total", total)]:
            cells = "".join(f"{lines[kind]:>12,}" for kind in KINDS)
            print(f"{room:<14}{lines['files']:>7}{lines['lines']:>8,}{cells}")
        long = {
            str(path.relative_to(root)): len(path.read_text(encoding="utf-8").splitlines())
            for path in folder.rglob("*.py")
        }
        print(f"over {LONG} lines:")
        for path, lines in sorted(long.items(), key=lambda item: -item[1]):
            if lines > LONG:
                print(f"  {lines:>5} {path}")
        print()


if __name__ == "__main__":
    main()
