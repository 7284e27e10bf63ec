"""The CAD of a run's classes, for `qs3.forest.fit`: points, normals and resting poses in a file."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import safetensors
import safetensors.numpy
from jaxtyping import Float, Float32

from qs3.errors import InputError
from qs3.files import parse_json, write_bytes
from qs3.forest.fit import Fit, PartModel, fit_part
from qs3.reading import reading

PARTS = "parts.safetensors"
CANDIDATES = 4
"""Number of likeliest classes whose CAD is fitted to a scan."""
RESIDUAL = 10.0
"""Subtracted from a class's log probability per metre of residual, so that it decides near ties. A
larger weight spoils right answers on real clouds: their residuals are as large as the differences
between parts."""
_LEAST = 1e-9
_WIDEST = 1e6  # metres


@dataclass(frozen=True)
class Part:
    """One mesh of a class."""

    class_name: str
    mesh: str
    model: PartModel
    resting: Float[np.ndarray, "p 3 3"]
    edges: Float32[np.ndarray, "e 2 3"]
    """Ends of its sharp edges in metres, to draw it."""


@dataclass(frozen=True)
class FittedPart:
    """The mesh that fits a scan best."""

    part: Part
    fit: Fit


def fit_best(scan: Float[np.ndarray, "n 3"], parts: Sequence[Part], name: str) -> FittedPart:
    """Align each mesh of a class with a scan; return the one with the least residual."""
    own = [part for part in parts if part.class_name == name]
    fits = [fit_part(scan, part.model, resting=part.resting) for part in own]
    best = min(range(len(own)), key=lambda i: fits[i].residual)
    return FittedPart(own[best], fits[best])


def fit_classes(
    scan: Float[np.ndarray, "n 3"], probabilities: Mapping[str, float], parts: Sequence[Part]
) -> tuple[dict[str, float], dict[str, FittedPart]]:
    """Align the CAD of the likeliest classes with a scan; correct the probabilities by residuals.

    Return probabilities proportional to p · exp(−10 r), with the residual r in metres, and the best
    mesh of each fitted class. Other classes get the largest residual among the fitted ones.
    """
    names = sorted(probabilities, key=lambda name: -probabilities[name])[:CANDIDATES]
    fits = {name: fit_best(scan, parts, name) for name in names}
    worst = max(fitted.fit.residual for fitted in fits.values())
    score = np.array(
        [
            np.log(max(share, _LEAST))
            - RESIDUAL * (fits[name].fit.residual if name in fits else worst)
            for name, share in probabilities.items()
        ]
    )
    shares = np.exp(score - np.logaddexp.reduce(score))
    ordered = sorted(zip(probabilities, shares.tolist(), strict=True), key=lambda item: -item[1])
    return dict(ordered), fits


@dataclass(frozen=True)
class Cad:
    """The CAD of a run's classes."""

    parts: tuple[Part, ...]
    residuals: tuple[float, ...] = ()
    """Evenly spaced quantiles of the residuals of held-out simulated scans, in metres, to the CAD
    of their predicted class; empty if the run did not measure them."""
    joint: tuple[float, ...] = ()
    """Quantiles of the sum of two shares of these scans: `Known.familiarity`, and the share of the
    scans that fit worse."""

    def familiarity(self, familiar: float, residual: float) -> float:
        """Return the share of held-out scans that are less familiar by prediction and fit together.

        ``familiar`` is the share by prediction alone; ``residual`` is in metres, to the CAD of the
        predicted class.
        """
        if not self.residuals:
            return familiar
        both = familiar + float(worse(self.residuals, residual))
        return float(np.interp(both, self.joint, np.linspace(0, 1, len(self.joint))))


def worse(residuals: Sequence[float], residual: float | np.ndarray) -> np.ndarray:
    """Return the share of scans with a larger residual; ``residuals`` are their quantiles."""
    levels = np.linspace(1, 0, len(residuals))
    return np.asarray(np.interp(residual, residuals, levels))


def save_parts(path: Path, cad: Cad) -> None:
    """Write the CAD to one safetensors file, atomically."""
    arrays = {}
    for i, part in enumerate(cad.parts):
        arrays |= {f"{i}/points": part.model.points, f"{i}/normals": part.model.normals}
        arrays |= {f"{i}/resting": np.ascontiguousarray(part.resting, np.float64)}
        arrays |= {f"{i}/edges": np.ascontiguousarray(part.edges, np.float32)}
    named = [[part.class_name, part.mesh] for part in cad.parts]
    facts = {"parts": named, "residuals": list(cad.residuals), "joint": list(cad.joint)}
    write_bytes(path, safetensors.numpy.save(arrays, {"qs3": json.dumps(facts)}))


def read_parts(path: Path, class_names: Sequence[str]) -> Cad:
    """Read the CAD of a run; each class needs at least one part."""
    if not path.is_file():
        raise InputError(
            f"{path.parent}: has no CAD to fit; train it again with --meshes and the folder of CAD"
        )
    with reading(path, "the CAD of a run"):
        with safetensors.safe_open(path, framework="numpy") as handle:  # pyright: ignore[reportPrivateImportUsage]
            facts = parse_json((handle.metadata() or {})["qs3"], path)
            parts = []
            for i, (name, mesh) in enumerate(facts["parts"]):
                points, normals, resting, edges = (
                    handle.get_tensor(f"{i}/{part}")
                    for part in ("points", "normals", "resting", "edges")
                )
                parts.append(Part(name, mesh, PartModel(points, normals), resting, edges))
            residuals, joint = (tuple(facts.get(name, ())) for name in ("residuals", "joint"))
        for part in parts:
            arrays = part.model.points, part.model.normals, part.resting, part.edges
            shapes = [array.shape[1:] for array in arrays]
            sound = shapes == [(3,), (3,), (3, 3), (2, 3)] and len(arrays[0]) == len(arrays[1])
            sound &= all(np.isfinite(array).all() for array in arrays)
            if not sound or not all(array.size for array in arrays[:3]):
                raise InputError(f"part {part.mesh} is damaged")
        if missing := {*class_names} - {part.class_name for part in parts}:
            raise InputError(f"has no CAD of {', '.join(sorted(missing))}")
        for values, most in ((residuals, _WIDEST), (joint, 2.0)):
            inside = all(type(value) in (int, float) and 0 <= value <= most for value in values)
            if not inside or (np.diff(values) < 0).any() or bool(residuals) != bool(joint):
                raise InputError("its residuals are not in rising order, from 0")
    return Cad(tuple(parts), residuals, joint)
