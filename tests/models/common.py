"""The textbook forms of `benchmarks/reference`, which are written apart from ours."""

import importlib.util
from pathlib import Path
from types import ModuleType

import torch
from torch import nn

REFERENCE = Path(__file__).parents[2] / "benchmarks" / "reference"


def textbook(name: str) -> ModuleType:
    """Load the module of a network, or of the one that it is a variant of."""
    path = REFERENCE / f"{name.replace('-', '_')}.py"
    path = path if path.is_file() else path.with_stem(name.split("-")[0])
    spec = importlib.util.spec_from_file_location(f"reference_{path.stem}", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def randomise(model: nn.Module, spread: float = 1.0, most: float = 2.0) -> None:
    """Give every normalisation a scale of either sign, a shift and statistics of its own."""
    with torch.no_grad():
        for layer in model.modules():
            if isinstance(layer, nn.BatchNorm1d | nn.BatchNorm2d):
                assert layer.running_mean is not None
                assert layer.running_var is not None
                layer.weight.normal_()
                layer.bias.normal_()
                layer.running_mean.normal_(std=spread)
                layer.running_var.uniform_(0.5, most)
