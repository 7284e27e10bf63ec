"""The device and the number format of a training."""

from dataclasses import replace

import pytest
import torch

from qs3.errors import InputError
from qs3.runs.device import autocast
from qs3.training import fit


def test_a_missing_gpu_is_refused_before_a_folder_is_made(settings, source, tmp_path):
    if torch.cuda.is_available():
        pytest.skip("this machine has a GPU")
    wrong = replace(settings, accelerator="cuda")
    with pytest.raises(InputError, match="accelerator 'cuda': PyTorch sees no NVIDIA GPU"):
        fit("source-only", source, None, wrong, run_dir=tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_layers_compute_in_the_number_format():
    layer, points = torch.nn.Linear(3, 2), torch.zeros(4, 3)
    for precision, dtype in (("32-true", torch.float32), ("bf16-mixed", torch.bfloat16)):
        with autocast(torch.device("cpu"), precision):
            assert layer(points).dtype == dtype


@pytest.mark.gpu
def test_bf16_learns_and_resumes_on_a_gpu(settings, source, tmp_path):
    if not torch.cuda.is_available():
        pytest.skip("torch sees no CUDA device")
    half = replace(settings, accelerator="cuda", precision="bf16-mixed")
    losses = [
        record.losses["source"]
        for record in fit("source-only", source, None, half, run_dir=tmp_path / "run").history
    ]
    assert losses[-1] < losses[0]
    again = fit("source-only", source, None, half, run_dir=tmp_path / "run")
    assert [record.losses["source"] for record in again.history] == losses
