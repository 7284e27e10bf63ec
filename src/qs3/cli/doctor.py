"""``qs3 doctor``: what is here, what is missing, how to get it."""

import importlib.metadata
import json
import platform
from typing import Any

from packaging.requirements import Requirement

from qs3.cli.text import show
from qs3.errors import QS3Error

_PURPOSE = {
    "ray": "qs3 generate --executor ray",
    "s3": "data sets at s3:// addresses",
    "gs": "data sets at gs:// addresses",
    "view": "qs3 view",
    "cad": "meshes in STEP, IGES and 3MF",
    "realsense": "a RealSense and its recordings",
    "ros": "recordings of ROS",
    "track": "qs3 train --log tensorboard|wandb",
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
    packages = {wanted.name: _version(wanted.name) for wanted in needed.pop("")}
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
            extra: extra in needed and all(map(_is_here, needed[extra])) for extra in _PURPOSE
        },
        "ready": all(packages.values()) and any(variants.values()),
    }


def _requirements() -> dict[str, list[Requirement]]:
    """What the installed qs3 says it needs on this Python, by extra; "" is for all."""
    wanted = [Requirement(line) for line in importlib.metadata.requires("qs3") or ()]
    extras = importlib.metadata.metadata("qs3").get_all("Provides-Extra") or []
    needed: dict[str, list[Requirement]] = {"": [], **{extra: [] for extra in extras}}
    for requirement in wanted:
        marker = requirement.marker
        where = [extra for extra in needed if marker is None or marker.evaluate({"extra": extra})]
        for extra in [""] if "" in where else where:
            needed[extra].append(requirement)
    return needed


def _is_here(wanted: Requirement) -> bool:
    """Whether a package is installed, in a version that will do."""
    version = _version(wanted.name)
    return version is not None and wanted.specifier.contains(version, prereleases=True)


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
