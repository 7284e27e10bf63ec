"""Packages re-export at run time the names that their type checkers see."""

import ast
import importlib
from pathlib import Path

import pytest


@pytest.mark.parametrize("name", ["training", "models", "adaptation"])
def test_every_public_name_of_a_lazy_package_loads(name):
    package = importlib.import_module(f"qs3.{name}")
    (block,) = [
        n for n in ast.parse(Path(package.__file__).read_bytes()).body if hasattr(n, "test")
    ]
    for line in block.body:
        for alias in line.names:
            module = importlib.import_module(line.module)
            assert getattr(package, alias.name) is getattr(module, alias.name)
