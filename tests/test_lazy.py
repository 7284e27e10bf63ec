"""Packages re-export at run time the names that their type checkers see."""

import ast
import importlib
from pathlib import Path

import pytest

import qs3


@pytest.mark.parametrize("name", ["training", "models", "adaptation"])
def test_every_public_name_of_a_lazy_package_loads(name):
    package = importlib.import_module(f"qs3.{name}")
    (block,) = [
        n for n in ast.parse(Path(package.__file__).read_bytes()).body if hasattr(n, "test")
    ]
    for line in block.body:
        for alias in line.names:
            module = importlib.import_module(line.module)
            assert alias.name in dir(package)
            assert getattr(package, alias.name) is getattr(module, alias.name)


def test_names_that_are_not_loaded_yet_are_listed():
    named = {"load", "scan", "adapt", "Classifier", "load_mesh", "load_sensor", "shapes"}
    assert named <= {*dir(qs3)}
