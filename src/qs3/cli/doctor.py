"""``qs3 doctor``: what works on this machine, and how to get what does not."""

import importlib
import importlib.metadata as metadata
import platform

from packaging.requirements import Requirement

from qs3.cli.text import show
from qs3.errors import QS3Error, describe_import_error

_NOT_TO_RUN = {"cycles", "dev", "docs"}  # Cycles has its own line; the others are for developers
_MODULES = {"opencv-python-headless": "cv2", "pillow": "PIL", "pyyaml": "yaml"}
_MODULES |= {"scikit-learn": "sklearn", "karellen-llvm-core": ""}  # LLVM has no module

_NO_LLVM = (
    "; scalar_rgb renders in its place, with the same noise but slower. On Linux x86-64: "
    "pip install 'qs3[llvm]'; elsewhere install libLLVM 19, or set DRJIT_LIBLLVM_PATH"
)


def doctor() -> int:
    """Print what works on this machine and how to get what does not.

    The exit code is 1 if it cannot scan.
    """
    from qs3.sensor.light.cycles import find_cycles
    from qs3.sensor.light.mitsuba import VARIANTS, usable

    wanted = [Requirement(line) for line in metadata.requires("qs3") or ()]
    packages = {need.name: _state(need) for need in wanted if need.marker is None}
    renderers = {variant: "ok" if usable(variant) else "does not work" for variant in VARIANTS}
    has_packages = all(state[:2] == "ok" for state in packages.values())
    ready = has_packages and "ok" in renderers.values()
    if renderers["llvm_ad_mono"] != "ok" and renderers["scalar_rgb"] == "ok":
        renderers["llvm_ad_mono"] += _NO_LLVM
    try:
        renderers["cycles"] = "ok" if find_cycles() else "not installed; in a checkout: make cycles"
    except QS3Error as error:
        renderers["cycles"] = str(error)
    extras = {}
    for extra in sorted({*metadata.metadata("qs3").get_all("Provides-Extra", [])} - _NOT_TO_RUN):
        needs = [need for need in wanted if need.marker and need.marker.evaluate({"extra": extra})]
        extras[extra] = next((state for state in map(_state, needs) if state[:2] != "ok"), "ok")
    show(f"Python {platform.python_version()}")
    parts = {"packages": packages, "renderers": renderers, "extras": extras}
    for title, part in parts.items():
        show(f"{title}:", *(f"  {name}: {state}" for name, state in part.items()))
    show("Ready." if ready else "Not ready: install what is missing above.")
    return 0 if ready else 1


def _state(need: Requirement) -> str:
    """Import a package and return "ok" with its version, or what is wrong and the fix."""
    fix = f"pip install '{need.name}{need.specifier}'"
    try:
        version = metadata.version(need.name)
        if not need.specifier.contains(version, prereleases=True):
            return f"{need.name} {version} does not fit; {fix}"
        if module := _MODULES.get(need.name, need.name.replace("-", "_")):
            importlib.import_module(module)
        return f"ok {version}"
    except (metadata.PackageNotFoundError, ModuleNotFoundError):
        return f"{need.name} is not installed; {fix}"
    except ImportError as error:
        return f"{need.name} cannot be loaded: {describe_import_error(error)}"
