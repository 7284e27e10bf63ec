"""Pieces of HTML. Every piece of text that comes from outside passes through `escape`."""

import base64
import html
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from jaxtyping import Int
from matplotlib.figure import Figure

from qs3.report.figure import png_bytes


def escape(text: object) -> str:
    """Return text that HTML shows as it is, inside and outside of quoted attributes.

    Example:
        >>> escape('<b title="x">')
        '&lt;b title=&quot;x&quot;&gt;'
    """
    return html.escape(str(text), quote=True)


def section(heading: str, *parts: str) -> str:
    """Return a section under a heading; nothing where all parts are empty."""
    body = "\n".join(part for part in parts if part)
    return f"<section>\n<h2>{escape(heading)}</h2>\n{body}\n</section>" if body else ""


def paragraph(text: str, kind: str = "") -> str:
    """Return a paragraph, with the CSS class ``kind`` if given."""
    return f'<p class="{kind}">{escape(text)}</p>' if kind else f"<p>{escape(text)}</p>"


def picture(figure: Figure, description: str, caption: str = "", wide: bool = False) -> str:
    """Return a figure as an image that lies in the page itself.

    Args:
        figure: What to draw.
        description: What a reader who cannot see it is told.
        caption: Text below.
        wide: Whether it keeps a readable size on a small screen, and scrolls sideways there.
    """
    data = base64.b64encode(png_bytes(figure, dpi=110 if wide else 150)).decode("ascii")
    below = f"<figcaption>{escape(caption)}</figcaption>" if caption else ""
    image = f'<img alt="{escape(description)}" src="data:image/png;base64,{data}">'
    return f'<figure><div class="shot{" wide" if wide else ""}">{image}</div>{below}</figure>'


def table(head: Sequence[str], rows: Sequence[Sequence[object]], text: Sequence[int] = ()) -> str:
    """Return a table that scrolls sideways where it is too wide.

    Args:
        head: Headings.
        rows: Cells.
        text: Indices of the columns that hold words: they are set to the left and may wrap.
    """

    def cells(values: Sequence[object], tag: str) -> str:
        opens = [f'<{tag} class="text">' if i in text else f"<{tag}>" for i in range(len(values))]
        return "".join(f"{o}{escape(v)}</{tag}>" for o, v in zip(opens, values, strict=True))

    body = "\n".join(f"<tr>{cells(row, 'td')}</tr>" for row in rows)
    return (
        f'<div class="scroll"><table>\n<thead><tr>{cells(head, "th")}</tr></thead>\n'
        f"<tbody>\n{body}\n</tbody></table></div>"
    )


def matrix_table(matrix: Int[np.ndarray, "k columns"], class_names: Sequence[str]) -> str:
    """Return a confusion matrix as a table, shaded by the share of the true class.

    Args:
        matrix: Counts [true, predicted]; one column more than classes counts other answers.
        class_names: Names in the order of the rows.
    """
    columns = [*class_names, "other"][: matrix.shape[1]]
    head = "".join(f"<th>{escape(name)}</th>" for name in ("true, predicted:", *columns))
    total = matrix.sum(axis=1, keepdims=True)
    share = np.divide(matrix, total, out=np.zeros(matrix.shape), where=total > 0)
    rows = []
    for name, counts, shares in zip(class_names, matrix, share, strict=True):
        cells = "".join(
            f'<td class="s{min(4, int(np.ceil(part * 4)))}">{count}</td>' if count else "<td></td>"
            for count, part in zip(counts, shares, strict=True)
        )
        rows.append(f'<tr><th class="text">{escape(name)}</th>{cells}</tr>')
    return (
        f'<div class="scroll"><table class="matrix">\n<thead><tr>{head}</tr></thead>\n'
        f"<tbody>\n{chr(10).join(rows)}\n</tbody></table></div>"
    )


def folded(summary: str, body: str) -> str:
    """Return a part that opens at a touch."""
    return f"<details><summary>{escape(summary)}</summary>\n{body}\n</details>"


def flatten(values: Mapping[str, Any], prefix: str = "") -> list[tuple[str, str]]:
    """Return the leaves of nested mappings as (dotted name, value) in their order.

    Example:
        >>> flatten({"seed": 1, "sensor": {"views": 5, "names": ("a", "b")}})
        [('seed', '1'), ('sensor.views', '5'), ('sensor.names', 'a, b')]
    """
    leaves: list[tuple[str, str]] = []
    for name, value in values.items():
        if isinstance(value, Mapping):
            leaves += flatten(value, f"{prefix}{name}.")
        elif isinstance(value, list | tuple):
            leaves.append((f"{prefix}{name}", ", ".join(map(str, value))))
        else:
            leaves.append((f"{prefix}{name}", str(value)))
    return leaves
