"""What a render node loads: the NumPy side must not bring PyTorch along."""

import subprocess
import sys

import pytest


@pytest.mark.parametrize(
    "module",
    [
        "qs3",
        "qs3.sensor.scan",
        "qs3.store.generate",
        "qs3.io.layouts.store",
        "qs3.evaluation",
        "qs3.adaptation.factory",
        "qs3.adaptation.validators",
        "qs3.models.factory",
        "qs3.cli.scan",
        "qs3.cli.generate",
    ],
)
def test_imports_without_torch(module):
    code = f"import sys, {module}; sys.exit('torch' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0


def test_answers_load_nothing_for_several_devices():
    code = "import sys, qs3.training.answers; sys.exit('lightning_fabric' in sys.modules)"
    assert subprocess.run([sys.executable, "-c", code]).returncode == 0


def test_settings_of_a_camera_import_nothing_heavy():
    heavy = {"cv2", "scipy", "trimesh", "embreex", "mitsuba", "drjit", "matplotlib", "torch"}
    modules = "qs3.sensor.realism, qs3.sensor.settings"
    code = f"import sys, {modules}; sys.exit(str({heavy} & {{*sys.modules}} or ''))"
    done = subprocess.run([sys.executable, "-c", code], stderr=subprocess.PIPE, text=True)
    assert not done.stderr.strip(), done.stderr


def test_public_names_are_those_of_the_readme():
    import qs3

    for name in ("scan", "shapes", "load_mesh", "Scan", "Sensor", "StereoRig", "Pose"):
        assert hasattr(qs3, name)
