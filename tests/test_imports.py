"""What a render node loads: the NumPy side must not bring PyTorch along."""

import ast
import importlib
import importlib.util
import subprocess
import sys
from pathlib import Path
from types import ModuleType

import pytest

import qs3

ROOT = Path(__file__).parents[1]


def test_names_that_are_not_loaded_yet_are_listed():
    named = {"load", "scan", "adapt", "Classifier", "load_mesh", "load_sensor", "shapes"}
    assert named <= {*dir(qs3)}


NUMPY_ALONE = "qs3.sensor.realism, qs3.sensor.stage.settings, qs3.models.factory"
SCANNING = "qs3.cli.scan, qs3.cli.generate, qs3.cli.sensors, qs3.cli.realism, qs3.cli.extract"
HEAVY = {"cv2", "scipy", "trimesh", "embreex", "mitsuba", "drjit", "matplotlib", "torch"}


@pytest.mark.parametrize(
    ("modules", "heavy"),
    [
        (NUMPY_ALONE, HEAVY),
        (SCANNING, {"torch", "mitsuba"}),
        ("qs3.models.pointnet2, qs3.training.predict", {"torch._dynamo"}),
    ],
)
def test_nothing_heavy_is_imported_before_it_is_needed(modules, heavy):
    code = f"import sys, {modules}; sys.exit(str({heavy} & {{*sys.modules}} or ''))"
    done = subprocess.run([sys.executable, "-c", code], stderr=subprocess.PIPE, text=True)
    assert not done.stderr.strip(), done.stderr


@pytest.mark.parametrize("folder", ["benchmarks", "docs", "examples", "tests"])
def test_what_scripts_and_tests_import_is_there(folder):
    """In those too that are seldom run."""
    count = 0
    for path in sorted((ROOT / folder).rglob("*.py")):
        tree, modules = ast.parse(path.read_text(encoding="utf-8")), {}
        for node in ast.walk(tree):
            if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "qs3":
                module = importlib.import_module(str(node.module))
                for alias in node.names:
                    inner = f"{node.module}.{alias.name}"
                    if not hasattr(module, alias.name):
                        assert importlib.util.find_spec(inner), f"{path.name}: {inner}"
                        importlib.import_module(inner)
                    modules[alias.asname or alias.name] = getattr(module, alias.name)
                    count += 1
        for node in ast.walk(tree):
            if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
                found = modules.get(node.value.id)
                if isinstance(found, ModuleType) and isinstance(node.ctx, ast.Load):
                    shown = f"{path.name}: {found.__name__}.{node.attr}"
                    assert hasattr(found, node.attr), shown
    assert count > 5
