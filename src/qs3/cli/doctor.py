"""``qs3 doctor``: what is here, what is missing, how to get it."""

import importlib.metadata
import json
import platform
import re
from typing import Any

from qs3.cli.text import show
from qs3.errors import QS3Error

_PURPOSE = {
    "ray": "qs3 generate --executor ray",
    "s3": "data sets at s3:// addresses",
    "gs": "data sets at gs:// addresses",
    "view": "qs3 view",
    "cad": "meshes in STEP, IGES and 3MF",
    "track": "qs3 train --log tensorboard",
    "export": "qs3 export",
}
_ADVICE = {
    "cuda_ad_mono": "needs an NVIDIA GPU whose driver has OptiX",
    "llvm_ad_mono": "needs a system libLLVM (19 is known to work; on Debian: libllvm19)",
    "scalar_rgb": "comes with the mitsuba wheel; reinstall it",
}


def doctor(json_output: bool = False) -> int:
    """Tell what works on this machine and how to get what does not.

    Args:
        json_output: Print JSON in place of text.
    """
    machine = examine()
    if json_output:
        show(json.dumps(machine, indent=2))
    else:
        _print(machine)
    return 0 if machine["ready"] else 1


def examine() -> dict[str, Any]:
    """Look at packages, Mitsuba's variants, Cycles, the device for training and the extras."""
    from qs3.sensor.render.mitsuba import VARIANTS, usable

    needed = _requirements()
    packages = {name: _version(name) for name in needed.pop("")}
    variants = {variant: usable(variant) for variant in VARIANTS}
    device, threads = None, None
    if packages["torch"] is not None:
        import torch

        from qs3.training.threads import describe_threads

        device = torch.cuda.get_device_name() if torch.cuda.is_available() else "CPU"
        threads = describe_threads()
    return {
        "python": platform.python_version(),
        "packages": packages,
        "renderers": variants,
        "renderer": next((variant for variant in VARIANTS if variants[variant]), None),
        "cycles": _cycles(),
        "device": device,
        "threads": threads,
        "extras": {
            extra: all(_version(name) is not None for name in needed.get(extra, ()))
            for extra in _PURPOSE
        },
        "ready": all(packages.values()) and any(variants.values()),
    }


def _requirements() -> dict[str, list[str]]:
    """Packages that this version of qs3 says it needs, by extra; "" are those of all."""
    needed: dict[str, list[str]] = {"": []}
    for line in importlib.metadata.requires("qs3") or ():
        name = re.match(r"[\w.-]+", line)
        extra = re.search(r"extra == [\"']([\w-]+)", line)
        if name:
            needed.setdefault(extra[1] if extra else "", []).append(name[0])
    return needed


def _version(package: str) -> str | None:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return None


def _cycles() -> dict[str, str]:
    """Program and versions of Cycles, or ``fault``: why there is none."""
    from qs3.sensor.render.cycles import find_cycles

    try:
        program = find_cycles()
    except QS3Error as error:
        return {"fault": str(error)}
    return program or {
        "fault": "not here; in a checkout, make cycles brings it (or set QS3_BLENDER to a Blender "
        "4.2 or newer)"
    }


def _print(machine: dict[str, Any]) -> None:
    show(f"Python {machine['python']}")
    for name, version in machine["packages"].items():
        show(f"  {'ok     ' if version else 'MISSING'} {name} {version or ''}".rstrip())
        if version is None:
            show(f"          get it with: pip install {name}")
    show("Renderer (Mitsuba 3, fastest first)")
    for variant, works in machine["renderers"].items():
        used = "   <- used" if variant == machine["renderer"] else ""
        reason = "" if works else f": {_ADVICE[variant]}"
        show(f"  {'ok     ' if works else 'absent '} {variant}{reason}{used}")
    cycles = machine["cycles"]
    show("The paper's renderer (--renderer cycles; optional)")
    if "fault" in cycles:
        show(f"  absent  cycles: {cycles['fault']}")
    else:
        show(
            f"  ok      cycles: Blender {cycles['blender']} (Python {cycles['python']}), "
            f"{cycles['command']}"
        )
    show(f"Training on: {machine['device']}; {machine['threads']}")
    show("Extras (each for what stands beside it, and nothing else)")
    for extra, here in machine["extras"].items():
        how = "" if here else f": in a checkout, pip install -e '.[{extra}]'"
        show(f"  {'ok     ' if here else 'absent '} {extra} ({_PURPOSE[extra]}){how}")
    show(
        "Ready." if machine["ready"] else "Not ready: mend what is marked MISSING or absent above."
    )
