"""Write the table of sizes in docs/models.md: parameters and multiply-adds, ours and published.

Multiply-adds of matrix products and convolutions are counted on a run (`torch.utils.flop_counter`)
at one cloud of 1,024 points and 40 classes, for our form and, where there is one, for the textbook
form in benchmarks/reference. Published values, with their sources, are in the list below.

Usage: ``python docs/make_models_table.py`` (from the repository)
"""

import importlib.util
from pathlib import Path
from types import ModuleType

import torch
from torch import nn
from torch.utils.flop_counter import FlopCounterMode

from qs3.models import create_model, list_models

_ROOT = Path(__file__).parent.parent
_PAGE = _ROOT / "docs" / "models.md"
_START, _END = "<!-- sizes: docs/make_models_table.py -->", "<!-- end of sizes -->"

# Name: parameters in millions, multiply-adds in millions, where they stand.
PUBLISHED = {
    "pointnet": ("3.5", "440", "PointNet, Table 6"),
    "pointnet2": ("1.48", "1,684", "RS-CNN, complexity"),
    "rscnn": ("1.41", "295", "RS-CNN, complexity"),
    "simpleview": ("0.8", "–", "SimpleView, §4"),
}


def multiply_adds(model: nn.Module) -> float:
    """Multiply-adds of one forward pass in evaluation, in millions."""
    points = torch.randn(1, 1024, 3, generator=torch.Generator().manual_seed(0)) * 0.4
    with FlopCounterMode(display=False) as counter, torch.no_grad():
        model.eval()(points)
    return counter.get_total_flops() / 2e6


def reference(name: str) -> ModuleType | None:
    """The textbook form of a network, by the name `create_model` takes; None where ours is it."""
    stem = name.replace("-", "_")
    path = _ROOT / "benchmarks" / "reference" / f"{stem}.py"
    if not path.is_file():
        return None
    spec = importlib.util.spec_from_file_location(f"reference_{stem}", path)
    assert spec is not None and spec.loader is not None  # noqa: S101
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def table() -> str:
    """The table as Markdown."""
    lines = [
        "| network | parameters, M | published | multiply-adds, M: ours | textbook | published "
        "| source |",
        "|---|---|---|---|---|---|---|",
    ]
    for name in list_models():
        torch.manual_seed(0)
        model = create_model(name, 40)
        size = sum(p.numel() for p in model.parameters()) / 1e6
        ours, book = multiply_adds(model), reference(name)
        textbook = f"{multiply_adds(book.from_ours(model)):,.0f}" if book else "–"
        size_there, adds_there, source = PUBLISHED.get(name, ("–", "–", ""))
        lines.append(
            f"| `{name}` | {size:.2f} | {size_there} | {ours:,.0f} | {textbook} "
            f"| {adds_there} | {source} |"
        )
    return "\n".join(lines)


def main() -> None:
    """Put the table between its marks."""
    text = _PAGE.read_text()
    before, rest = text.split(_START)
    _, after = rest.split(_END)
    _PAGE.write_text(f"{before}{_START}\n{table()}\n{_END}{after}")
    print(_PAGE)


if __name__ == "__main__":
    main()
