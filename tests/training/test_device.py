"""The device and the number format of a training."""

from dataclasses import replace

import pytest
import torch

from qs3.errors import InputError
from qs3.training import fit
from qs3.training.device import autocast, choose_device


def test_a_missing_gpu_is_refused_before_a_folder_is_made(settings, source, tmp_path):
    if torch.cuda.is_available():
        pytest.skip("this machine has a GPU")
    wrong = replace(settings, accelerator="cuda")
    with pytest.raises(InputError, match="accelerator 'cuda': PyTorch sees no NVIDIA GPU"):
        fit("source-only", source, None, wrong, run_dir=tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_a_number_format_that_a_cpu_lacks_is_refused(settings):
    with pytest.raises(InputError, match="16-mixed needs a GPU"):
        choose_device(replace(settings, precision="16-mixed"))


def test_layers_compute_in_the_number_format():
    layer, points = torch.nn.Linear(3, 2), torch.zeros(4, 3)
    for precision, dtype in (("32-true", torch.float32), ("bf16-mixed", torch.bfloat16)):
        with autocast(torch.device("cpu"), precision):
            assert layer(points).dtype == dtype


@pytest.mark.gpu
@pytest.mark.parametrize("clip_norm", [None, 1.0])
def test_16_mixed_learns_and_resumes(settings, source, tmp_path, clip_norm):
    if not torch.cuda.is_available():
        pytest.skip("torch sees no CUDA device")
    half = replace(settings, accelerator="cuda", precision="16-mixed", clip_norm=clip_norm)
    losses = [
        record.losses["source"]
        for record in fit("source-only", source, None, half, run_dir=tmp_path / "run").history
    ]
    assert losses[-1] < losses[0]
    again = fit("source-only", source, None, half, run_dir=tmp_path / "run")
    assert [record.losses["source"] for record in again.history] == losses
