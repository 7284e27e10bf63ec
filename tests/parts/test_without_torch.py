"""A forest needs no PyTorch, whose import takes longer than its training."""

import subprocess
import sys

import numpy as np


def test_a_forest_is_trained_without_torch(tmp_path):
    points = np.random.default_rng(0).random((8, 64, 3), dtype=np.float32)
    labels = np.arange(8) % 2
    np.savez(tmp_path / "a.npz", points=points, label=labels, class_names=np.array(["a", "b"]))
    words = ["train", "--model", "forest", "--source", "a.npz", "--out", "run"]
    code = f"""import sys
from qs3.cli import run
from qs3.parts import forest
forest.TREES = 9
run({words})
sys.exit('torch' in sys.modules)"""
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=tmp_path, stderr=subprocess.PIPE, text=True
    )
    assert done.returncode == 0, done.stderr
    assert (tmp_path / "run" / "forest.safetensors").is_file()
