"""The way for own parts in one call: CAD and unlabelled scans in, a classifier of the scans out."""

import logging
import operator
import shlex
import warnings
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal

import numpy as np

from qs3.adaptation.selection import SingleClassWarning
from qs3.errors import InputError, no_such
from qs3.files import claim_folder, write_bytes
from qs3.forest.parts import Part
from qs3.io import load_clouds, load_unlabelled
from qs3.io.clouds import PointClouds, UnlabelledClouds
from qs3.io.like import Range, measure
from qs3.io.like import like as resemble
from qs3.io.ply import ply_bytes
from qs3.meshes import collect
from qs3.meshes.sizes import Unit
from qs3.processors import usable_processors
from qs3.store.generate import generate
from qs3.store.manifest import FAILURES, read_failures
from qs3.store.scan_item import RECIPES, settings_for
from qs3.training.answers import list_clouds
from qs3.training.cad import read_cad, save_cad
from qs3.training.classifier import Classifier, Clouds
from qs3.training.config import PRESETS, TrainSettings, preparation_of, usual_preset
from qs3.training.forest import train_forest
from qs3.training.history import describe_held_out
from qs3.training.labels import read_labels
from qs3.training.prepared import load_whole
from qs3.training.rounds import remarks
from qs3.training.run import FOREST_MODEL, SETTINGS

_LOG = logging.getLogger(__name__)
_METHODS = ("qbst", "spst", "source-only")
_FACTOR = 1.5  # of lengths, from which the units are doubted
_TIMEOUT = 900.0  # seconds of a scan, as in qs3 generate


def adapt(
    cad: str | Path,
    scans: Clouds,
    out: str | Path = "adapted",
    *,
    camera: str = "d435",
    units: Unit | None = None,
    up: Literal["z", "y"] | None = None,
    labels: str | Path | None = None,
    like: bool = True,
    method: Literal["qbst", "spst", "source-only"] = "qbst",
    workers: int | None = None,
    seed: int = 0,
    say: Callable[[str], None] = _LOG.info,
) -> Classifier:
    """Make a classifier of known parts from their CAD and unlabelled scans of them.

    The meshes are scanned as they lie on a table (``qs3 generate --recipe parts``). A forest
    learns from scans, clean twins and surfaces, and is adapted to your scans by rounds of
    quasi-balanced self-training. All files stay in ``out``; the same call continues after a stop.
    For categories, such as furniture, train a network: `qs3.training.fit`.

    Args:
        cad: Folder of meshes: a file or a folder a class.
        scans: Clouds of the camera, one part each, z up, in metres. Labels are left behind.
        out: Folder for the simulated scans (``source``) and the run (``run``).
        camera: Preset of the camera, or a TOML file of your own.
        units: Unit of the mesh files; by default what they say, else m up to a longest side of 5,
            mm above.
        up: Up axis of every mesh file; by default y for glTF, z for all others.
        labels: CSV of a few labelled scans, columns file and class. The run is then few-label.
        like: Whether to scan with as many points as your scans have, and from where the camera
            stood, if they record it (`qs3 segment` does).
        method: Rounds of self-training on the scans, or none.
        workers: Processes that scan; None takes one a core, 0 scans in this one.
        seed: Root of all random steps.
        say: Called with each line of talk: measures, and the command that repeats a step alone.

    Raises:
        InputError: If something cannot be read, or the folder holds another run.
    """
    out, seed = Path(out), operator.index(seed)
    if method not in _METHODS:
        raise no_such(f"unknown method {method!r} of a forest", method, _METHODS)
    source, run = out / "source", out / "run"
    place = _as_files(scans, out / "scans")
    # Faults of what was given are raised before a mesh is scanned.
    train = TrainSettings(model=FOREST_MODEL, seed=seed, preparation=preparation_of(None))
    how = (train.num_points, train.preparation)
    target = load_whole(load_unlabelled, place, *how)
    items = collect(cad, up=up)
    settings = replace(RECIPES["parts"], sensor=camera, units=units, seed=seed)
    found = measure(place)
    if like:
        say(f"{place}: {found}")
        settings = resemble(settings, found)
    settings = settings_for(settings, items, [cad], 10)
    labelled = None
    if labels is not None:
        labelled = read_labels(Path(labels), settings.classes, Path(place))
        files = {str(path.resolve()) for path in list_clouds([Path(place)])}
        if method != "source-only" and files <= {*labelled.ids}:
            raise InputError(f"{labels}: labels every scan; choose the method source-only")
    parts = read_cad(cad, settings.classes, units, up)
    if doubt := doubt_units(found.size, parts):
        say(doubt)
    claim_folder(run, SETTINGS)

    files = options(meshes=cad, units=units, up=up)
    simulated = options(sensor=camera, like=place if like else None, seed=seed, workers=workers)
    say(command("generate", "--recipe", "parts", *files, *simulated, *options(out=source)))
    workers = usable_processors() if workers is None else workers
    generate(items, source, settings, workers=workers, timeout=_TIMEOUT)
    if failed := read_failures(source):
        first = f"{failed[0]['id']}: {failed[0]['reason']}"
        say(f"{len(failed)} scans failed, see {source / FAILURES}; the first: {first}")

    given = options(source=source, target=place, method=method, labels=labels, seed=seed, out=run)
    say(command("train", "--model", FOREST_MODEL, "--source-cloud", "all", *given, *files))
    preset = None if method == "source-only" else usual_preset(method)
    rounds = None if preset is None else replace(PRESETS[preset], rule=method)
    clouds = load_whole(load_clouds, source, *how, cloud="all")
    with warnings.catch_warnings():  # `remarks` names them
        warnings.simplefilter("ignore", SingleClassWarning)
        made = train_forest(method, clouds, target, train, rounds, run_dir=run, preset=preset,
                            labelled=labelled)  # fmt: skip
    save_cad(run, parts, clouds, made.held_out)
    if (held := made.held_out) is not None:
        say(describe_held_out(held.accuracy, len(held.rows), are_scans=True))
    if rounds is not None:
        for line in remarks(made.rounds, rounds, clouds.class_names):
            say(line)
    return Classifier.load(run)


def doubt_units(scans: Range, parts: Sequence[Part]) -> str:
    """Return a warning if all CAD is longer, or all shorter, than the scans of it; else nothing."""
    sides = [float(np.ptp(part.model.points, axis=0).max()) for part in parts]
    if scans[1] * _FACTOR >= min(sides) and scans[0] <= max(sides) * _FACTOR:
        return ""
    return (
        f"the CAD is {min(sides):.3g} to {max(sides):.3g} m long, the scans {scans[0]:.3g} to "
        f"{scans[1]:.3g} m: look at the contact sheet; name the CAD's unit with --units (m, cm, mm "
        "or in)"
    )


def options(**values: object) -> list[str]:
    """Return words of a command line; those of None are left out.

    Example:
        >>> options(scans_per_mesh=5, up=None)
        ['--scans-per-mesh', '5']
    """
    given = {name: value for name, value in values.items() if value is not None}
    pairs = [(f"--{name.replace('_', '-')}", str(value)) for name, value in given.items()]
    return [word for pair in pairs for word in pair]


def command(*words: object) -> str:
    """Return a command of qs3 as a shell takes it."""
    return f"qs3 {shlex.join(map(str, words))}"


def _as_files(scans: Clouds, folder: Path) -> str | Path:
    if isinstance(scans, str | Path):
        return scans
    if isinstance(scans, PointClouds | UnlabelledClouds):
        scans = scans.points
    clouds = [np.asarray(cloud, dtype=np.float32) for cloud in scans]  # type: ignore[union-attr]
    if not clouds or any(cloud.ndim != 2 or cloud.shape[1:] != (3,) for cloud in clouds):
        raise InputError("scans: give a folder, or several clouds of shape [n 3]")
    names = [f"{row:06d}.ply" for row in range(len(clouds))]
    if others := sorted({path.name for path in folder.glob("*")} - {*names, "objects.csv"}):
        raise InputError(
            f"{folder}: holds scans of another call ({others[0]}); name another folder"
        )
    for name, cloud in zip(names, clouds, strict=True):
        write_bytes(folder / name, ply_bytes(cloud))
    return folder
