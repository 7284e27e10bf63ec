"""``qs3 doctor``: what is here, what is missing, how to get it."""

import importlib.metadata
import importlib.util
import json
import platform
from typing import Any

from qs3.errors import QS3Error

_CORE = (
    "numpy",
    "scipy",
    "trimesh",
    "embreex",
    "mitsuba",
    "opencv-python-headless",
    "pyarrow",
    "torch",
    "lightning-fabric",
    "safetensors",
    "jaxtyping",
    "tqdm",
    "matplotlib",
    "tyro",
)
_EXTRAS = {
    "ray": ("ray", "data sets made on a cluster"),
    "view": ("viser", "the interactive viewer"),
    "track": ("tensorboard", "training curves in TensorBoard"),
    "export": ("onnx", "models as ONNX"),
}


def doctor(json_output: bool = False) -> int:
    """Tell what works on this machine and how to get what does not.

    Args:
        json_output: Print JSON in place of text.
    """
    found = examine()
    if json_output:
        print(json.dumps(found, indent=2))
    else:
        _print(found)
    return 0 if found["ready"] else 1


def examine() -> dict[str, Any]:
    """Look at packages, Mitsuba's variants, Cycles, the device for training and the extras."""
    from qs3.sensor.render.mitsuba import VARIANTS, usable

    packages: dict[str, str | None] = {}
    for name in _CORE:
        try:
            packages[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            packages[name] = None
    variants = {variant: usable(variant) for variant in VARIANTS}
    device = None
    if packages["torch"] is not None:
        import torch

        device = torch.cuda.get_device_name() if torch.cuda.is_available() else "CPU"
    return {
        "python": platform.python_version(),
        "packages": packages,
        "renderers": variants,
        "renderer": next((variant for variant in VARIANTS if variants[variant]), None),
        "cycles": _cycles(),
        "device": device,
        "extras": {
            extra: importlib.util.find_spec(module) is not None
            for extra, (module, _) in _EXTRAS.items()
        },
        "ready": all(packages.values()) and any(variants.values()),
    }


def _cycles() -> dict[str, str]:
    """Program and versions of Cycles, or ``fault``: why there is none."""
    from qs3.sensor.render.cycles import find_cycles

    try:
        found = find_cycles()
    except QS3Error as error:
        return {"fault": str(error)}
    return found or {
        "fault": "not here; in a checkout, make cycles brings it (or set QS3_BLENDER to a Blender "
        "4.2 or newer)"
    }


def _print(found: dict[str, Any]) -> None:
    print(f"Python {found['python']}")
    for name, version in found["packages"].items():
        print(f"  {'ok     ' if version else 'MISSING'} {name} {version or ''}".rstrip())
        if version is None:
            print(f"          get it with: pip install {name}")
    advice = {
        "cuda_ad_mono": "needs an NVIDIA GPU whose driver has OptiX",
        "llvm_ad_mono": "needs a system libLLVM (19 is known to work; on Debian: libllvm19)",
        "scalar_rgb": "comes with the mitsuba wheel; reinstall it",
    }
    print("Renderer (Mitsuba 3, fastest first)")
    for variant, works in found["renderers"].items():
        used = "   <- used" if variant == found["renderer"] else ""
        reason = "" if works else f": {advice[variant]}"
        print(f"  {'ok     ' if works else 'absent '} {variant}{reason}{used}")
    cycles = found["cycles"]
    print("The paper's renderer (--renderer cycles; optional)")
    if "fault" in cycles:
        print(f"  absent  cycles: {cycles['fault']}")
    else:
        print(
            f"  ok      cycles: Blender {cycles['blender']} (Python {cycles['python']}), "
            f"{cycles['command']}"
        )
    print(f"Training on: {found['device']}")
    print("Extras (for commands to come; nothing in this version needs them)")
    for extra, here in found["extras"].items():
        how = "" if here else f": in a checkout, pip install -e '.[{extra}]'"
        print(f"  {'ok     ' if here else 'absent '} {extra} ({_EXTRAS[extra][1]}){how}")
    print("Ready." if found["ready"] else "Not ready: mend what is marked MISSING or absent above.")
