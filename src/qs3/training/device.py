"""The device and the number format of a training."""

import torch

from qs3.errors import InputError, say_once
from qs3.training.config import Precision, TrainSettings

_FORMATS = {"bf16-mixed": torch.bfloat16, "16-mixed": torch.float16}


def choose_device(settings: TrainSettings) -> torch.device:
    """Return the device that the settings name."""
    name = settings.accelerator
    if name == "auto":
        name = "cuda" if torch.cuda.is_available() else "cpu"
    if name == "cuda" and not torch.cuda.is_available():
        raise InputError(
            "accelerator 'cuda': PyTorch sees no NVIDIA GPU here; use --accelerator cpu "
            "(qs3 doctor shows the devices)"
        )
    if settings.precision == "16-mixed" and name == "cpu":
        raise InputError("precision 16-mixed needs a GPU; on a CPU use 32-true or bf16-mixed")
    if settings.precision == "bf16-mixed" and name == "cpu" and not has_bf16_units():
        say_once(
            "bf16-mixed on a CPU without bf16 units is slower than 32-true, with coarser rounding"
        )
    return torch.device(name)


def autocast(device: torch.device, precision: Precision) -> torch.autocast:
    """Return a context that computes in the number format; it does nothing for 32-true."""
    return torch.autocast(device.type, dtype=_FORMATS.get(precision), enabled=precision in _FORMATS)


def has_bf16_units() -> bool:
    """Return whether this CPU multiplies bfloat16 in hardware; True if PyTorch does not know."""
    capabilities = getattr(torch.cpu, "get_capabilities", dict)()
    if capabilities.get("architecture") != "x86_64":
        return True
    return bool(capabilities.get("avx512_bf16") or capabilities.get("amx_bf16"))
