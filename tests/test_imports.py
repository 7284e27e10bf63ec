"""What a render node loads: the NumPy side must not bring PyTorch along."""

import ast
import importlib
import importlib.util
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


@pytest.mark.parametrize(
    "module",
    [
        "qs3.store.generate",
        "qs3.models.factory",
        "qs3.cli.generate",
    ],
)
def test_imports_without_torch(module):
    code = f"import sys, {module}; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0


def test_settings_of_a_camera_import_nothing_heavy():
    heavy = {"cv2", "scipy", "trimesh", "embreex", "mitsuba", "drjit", "matplotlib", "torch"}
    modules = "qs3.sensor.realism, qs3.sensor.stage.settings"
    code = f"import sys, {modules}; sys.exit(str({heavy} & {{*sys.modules}} or ''))"
    done = subprocess.run([sys.executable, "-c", code], stderr=subprocess.PIPE, text=True)
    assert not done.stderr.strip(), done.stderr


@pytest.mark.parametrize("folder", ["benchmarks", "docs", "examples"])
def test_what_scripts_import_is_there(folder):
    count = 0
    for path in sorted((ROOT / folder).glob("*.py")):
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
            if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "qs3":
                module = importlib.import_module(str(node.module))
                for alias in node.names:
                    inner = f"{node.module}.{alias.name}"
                    found = hasattr(module, alias.name) or importlib.util.find_spec(inner)
                    assert found, f"{path.name}: {inner}"
                    count += 1
    assert count > 5
