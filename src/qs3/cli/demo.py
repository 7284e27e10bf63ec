"""``qs3 demo``: a network that comes with qs3, adapted to one camera without labels, to a report.

The target is simulated: shapes that the network has not seen, in rooms, each before one camera
once; their labels serve the score alone, as they do of a small network that learns here from whole
surfaces, to compare with. Or it is a folder of the user's own scans, without labels.
"""

import dataclasses
import shutil
import statistics
import time
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from qs3.cli.options import Flat
from qs3.cli.text import columns, show, tell
from qs3.errors import InputError
from qs3.files import claim_folder, write_json, write_text

if TYPE_CHECKING:
    from qs3.io.clouds import UnlabelledClouds
    from qs3.report.contents import Report
    from qs3.training import SelfTrainingSettings

_MARKER = "demo.json"
_SHOWN = 200  # of the user's scans, on the page
_SURFACES = "surfaces"
_PASSES = 30  # over the surfaces, which are learnt to 95 % and more by then
_POINTS = 1024  # a surface, of which the network draws its own


@dataclass(frozen=True)
class DemoSettings:
    """What the demo runs: small enough for ten minutes on two cores without a GPU."""

    network: str = "rooms"
    """Network that comes with qs3, or a run."""
    per_class: int = 15
    """Objects a class of the simulated target."""
    sensor: str = "d435"
    """Preset of its sensor."""
    source_per_class: int = 10
    """Objects a class of a source like the network's own, scanned by cameras that are drawn: the
    rounds learn from it too, lest a class be forgotten. 0 leaves it out."""
    surfaces_per_class: int = 60
    """Shapes a class whose whole surfaces, as CAD has them, a network learns here to be compared
    with; not beside your own scans. 0 leaves it out."""
    samples: int = 4
    """Rays a pixel."""
    variant: Literal["auto", "cuda_ad_mono", "llvm_ad_mono", "scalar_rgb"] = "auto"
    """Variant of Mitsuba."""
    share: float = 0.5
    """Share of the clouds that each round takes for confident: few scans make rounds too."""
    rounds: int = 5
    """Rounds of self-training."""
    round_epochs: int = 4
    """Passes over the selected clouds in a round."""
    seed: int = 0
    """Root of all seeds."""
    workers: int = 2
    """Processes that scan."""


def demo(
    out: Path = Path("demo"),
    scans: Path | None = None,
    settings: Flat[DemoSettings] = DemoSettings(),
) -> int:
    """Adapt a network that comes with qs3 to a camera, without labels: scan, adapt, report.

    Args:
        out: Folder to write; run again after a stop to go on.
        scans: Folder of your own scans in place of the simulated ones: files of points, an object
            each, z up, in metres. Nothing is scored then, as they have no labels.
        settings: Size of the demo.
    """
    from qs3.cli.train import NO_ROUND
    from qs3.meshes.classes import POINTDA10, canonical
    from qs3.training.answers import list_clouds
    from qs3.training.checkpoint import load_model
    from qs3.training.run import is_run
    from qs3.training.shipped import find_run, not_a_run

    start = time.perf_counter()
    if scans is not None and not scans.is_dir():
        raise InputError(f"{scans}: no such folder; name a folder of scans for --scans")
    files = [] if scans is None else list_clouds([scans])
    network = find_run(settings.network)
    if not is_run(network):  # a folder of this name, say, with something else in it
        raise InputError(f"{network}: {not_a_run()}")
    # What is wrong with any of these is told before anything is scanned.
    known = set(map(canonical, load_model(network).class_names))
    if (scans is None or settings.source_per_class) and not known.issuperset(POINTDA10):
        raise InputError(
            f"{network}: does not know all classes of the shapes that the demo scans "
            f"({', '.join(POINTDA10)}); name your scans for --scans, and --source-per-class 0"
        )
    rounds = _rounds(settings)
    clouds = None if scans is None else _read_target(scans, network)
    folder = claim_folder(out, _MARKER)
    write_json(folder / _MARKER, dataclasses.asdict(settings))
    before = folder / "before"  # the records of its scores are written there
    shutil.copytree(network, before, dirs_exist_ok=True)
    compares = scans is None and settings.surfaces_per_class > 0
    steps = 5 if compares else 4
    # The network has seen draws of 0.
    if settings.source_per_class:
        tell(f"[1/{steps}] scan a small source: built-in shapes in rooms, cameras drawn")
        _scan(folder / "source", settings, settings.source_per_class, 2000 + settings.seed)
    if scans is None:
        seed, sensor = 1000 + settings.seed, settings.sensor
        tell(f"[2/{steps}] scan the target: other shapes, single views by the sensor {sensor}")
        _scan(folder / "target", settings, settings.per_class, seed, sensor=sensor)
    else:
        tell(f"[2/{steps}] read {scans}")
    if compares:
        tell(f"[3/{steps}] train a network on whole surfaces alone, to compare with")
        _learn_surfaces(before, settings, folder / _SURFACES)
    tell(f"[{steps - 1}/{steps}] adapt to the target without labels")
    if clouds is None:
        clouds = _read_target(folder / "target", before)
    has_trained = _adapt(clouds, rounds, before, settings, folder)
    tell(f"[{steps}/{steps}] report")
    path = folder / "report.html"
    _score(folder, settings, path) if scans is None else _tell_scans(folder, files, settings, path)
    show(f"report: {path}")
    tell(f"{time.perf_counter() - start:.0f} s. Open {path} in a browser.")
    return 0 if has_trained else NO_ROUND


def _scan(folder: Path, settings: DemoSettings, per_class: int, seed: int, **how: Any) -> None:
    from qs3.meshes import collect
    from qs3.store.failures import read_failures
    from qs3.store.generate import generate
    from qs3.store.scan_item import RECIPES

    recipe = dataclasses.replace(
        RECIPES["rooms"],
        views=1,
        per_class=per_class,
        scans_per_mesh=1,
        renderer=_renderer(settings),
        seed=seed,
        rows_per_shard=10,
        **how,
    )
    items = collect("shapes", per_class=per_class, seed=seed)
    generate(items, folder, recipe, workers=settings.workers)
    if failures := read_failures(folder):
        tell(f"{len(failures)} of {len(items)} could not be scanned and are left out; the first: "
             f"{failures[0]['reason']}")  # fmt: skip


def _renderer(settings: DemoSettings) -> Any:
    from qs3.sensor.settings import CameraSettings

    return CameraSettings(samples=settings.samples, variant=settings.variant).make_renderer()


def _learn_surfaces(network: Path, settings: DemoSettings, folder: Path) -> None:
    """Train a network like the one that comes with qs3 on shapes as they are, seen by no camera."""
    import numpy as np

    from qs3.io.clouds import Origin, PointClouds, relabel
    from qs3.meshes import collect, sample_surface
    from qs3.meshes.classes import POINTDA10
    from qs3.meshes.sizes import class_size
    from qs3.training import fit, load_model
    from qs3.training.config import LIGHT
    from qs3.training.run import train_settings

    seed = 3000 + settings.seed
    rng = np.random.default_rng(seed)
    items = collect("shapes", per_class=settings.surfaces_per_class, seed=seed)
    points = []
    for item in items:
        mesh = item.load()
        size = class_size(mesh, item.class_name, rng) / mesh.extents.max()
        points.append(sample_surface(mesh, _POINTS, rng) * np.float32(size))
    labels = np.array([POINTDA10.index(item.class_name) for item in items])
    ids, origin = tuple(item.id for item in items), Origin("built-in shapes", cloud="surface")
    clouds = PointClouds(np.stack(points), labels, POINTDA10, ids, origin=origin)
    clouds = relabel(clouds, load_model(network).class_names, None, origin.name)
    how = {"epochs": _PASSES, "holdout": 0.0, "validate_every": 0, "augmentation": LIGHT}
    train = dataclasses.replace(train_settings(network), seed=settings.seed, **how)
    fit("source-only", clouds, None, train, run_dir=folder)


def _adapt(
    clouds: "UnlabelledClouds",
    rounds: "SelfTrainingSettings",
    before: Path,
    settings: DemoSettings,
    folder: Path,
) -> bool:
    """Adapt the network; tells whether any round trained it."""
    from qs3.io import load_clouds
    from qs3.training import fit, load_model, load_whole
    from qs3.training.rounds import all_skipped, remarks
    from qs3.training.run import train_settings

    train = dataclasses.replace(train_settings(before), seed=settings.seed)
    source = None
    if settings.source_per_class:
        names = load_model(before).class_names
        part: dict[str, Any] = {"cloud": "all", "class_names": names}
        size = train.num_points, train.preparation
        source = load_whole(load_clouds, folder / "source", *size, **part)
    how = {"run_dir": folder / "qbst", "warm_up": before, "preset": "gentle"}
    done = fit("qbst", source, clouds, train, rounds, **how)
    lines = remarks(done.rounds, rounds, done.source.class_names, share="--share")
    tell(*(f"qs3: {line}" for line in lines))
    return not all_skipped(done.rounds)


def _rounds(settings: DemoSettings) -> "SelfTrainingSettings":
    from qs3.training import self_training_preset

    own = {"threshold_share": settings.share, "rounds": settings.rounds}
    own |= {"epochs": settings.round_epochs, "source_loss": settings.source_per_class > 0}
    return self_training_preset("gentle", **own)


def _read_target(target: Path, run: Path) -> "UnlabelledClouds":
    from qs3.io import load_unlabelled
    from qs3.training import load_whole
    from qs3.training.prepared import require_finite
    from qs3.training.run import train_settings

    how = train_settings(run)
    clouds = load_whole(load_unlabelled, target, how.num_points, how.preparation)
    require_finite(clouds.points, clouds.ids, f"{target}: ")
    return clouds


def _score(folder: Path, settings: DemoSettings, path: Path) -> None:
    """Score the networks on the simulated target, and write the page."""
    from qs3 import shapes
    from qs3.report.montage import montage_view
    from qs3.report.page import write_report
    from qs3.sensor.scan import scan
    from qs3.training import evaluate

    names = {"before": f"{settings.network} as it comes", "qbst": f"{settings.network} after QBST"}
    compared: tuple[str, ...] = ()
    if settings.surfaces_per_class > 0:
        names = {_SURFACES: "surfaces alone"} | names
        compared = (
            f"To compare with, a network like {settings.network} learnt here from surfaces alone, "
            f"seen by no camera: {settings.surfaces_per_class} shapes a class, {_PASSES} epochs.",
        )
    records = {what: evaluate(folder / name, folder / "target") for name, what in names.items()}
    page = _page(folder, settings)
    made = scan(
        shapes.make("chair", seed=settings.seed),
        sensor=settings.sensor,
        scene="room",
        views=1,
        seed=settings.seed,
        renderer=_renderer(settings),
        keep_images=True,
    )
    clouds = records[names["qbst"]].test.clouds
    lines = []
    for what, record in records.items():
        low, high = record.scores.interval
        lines.append(f"accuracy on the target, {what + ':':21} {record.scores.accuracy:.1%}  "
                     f"(95 % interval {low:.0%} to {high:.0%})")  # fmt: skip
    page = dataclasses.replace(
        page,
        summary=f"{settings.network}, which comes with qs3, was adapted by quasi-balanced "
        f"self-training to {clouds} simulated scans of shapes that it had not seen: single views "
        f"by the sensor {settings.sensor} in rooms. No label was used but for the scores.",
        montage=montage_view(made)[0],
        montage_title=f"chair · sensor {settings.sensor}",
        notes=(
            *page.notes,
            *compared,
            "The target is simulated, of the kind that the network was trained on, and small: this "
            "shows how adaptation goes, not what it brings on your camera. --scans does that.",
        ),
    )
    verdict = write_report(path, page)
    show(*lines)
    show(f"({clouds} clouds, whose labels served this score alone)")
    if verdict is not None:
        show(f"QBST against none: {verdict.opening.lower()}.")


def _tell_scans(folder: Path, files: list[Path], settings: DemoSettings, path: Path) -> None:
    """Tell what both networks take the user's scans for, and write table and page."""
    from qs3.report.contents import Cloud
    from qs3.report.page import write_report
    from qs3.training.answers import answers_csv, predict_files, read_listed

    before, after = (list(predict_files(folder / name, files)) for name in ("before", "qbst"))
    write_text(folder / "predictions.csv", answers_csv(after, top=3))
    best = {name: [answer.best()[0] for answer in said] for name, said in
            {"before": before, "after": after}.items()}  # fmt: skip
    page = _page(folder, settings)
    rows: list[tuple[str, ...]] = [("class", "before", "after", "median confidence after")]
    for name in page.class_names:
        sure = [share for taken, share in best["after"] if taken == name]
        count = sum(taken == name for taken, _ in best["before"])
        median = f"{statistics.median(sure):.0%}" if sure else "–"
        rows.append((name, str(count), str(len(sure)), median))
    scans = [scan for file in files for scan in read_listed(file)]
    clouds = [
        Cloud(points, name, f"{file.name}: {name}, {share:.0%}")
        for (file, points), (name, share) in list(zip(scans, best["after"], strict=True))[:_SHOWN]
    ]
    page = dataclasses.replace(
        page,
        summary=f"{settings.network}, which comes with qs3, was adapted by quasi-balanced "
        f"self-training to {len(scans)} scans without labels. Clouds stand below the class that "
        "the adapted network takes them for; whether that is right nobody has told it.",
        clouds={"scans, by predicted class": clouds},
        notes=tuple(
            f"{name}: {new} scans (before: {old}), median confidence {median}"
            for name, old, new, median in rows[1:]
        ),
    )
    write_report(path, page)
    show(*columns(rows, 1))
    show(f"predictions: {folder / 'predictions.csv'}")


def _page(folder: Path, settings: DemoSettings) -> "Report":
    from qs3.report.collect import collect, look
    from qs3.report.settings import ReportSettings

    page, _ = collect(look(folder), ReportSettings(run=folder / "qbst"))
    plain = dataclasses.asdict(settings)
    return dataclasses.replace(
        page,
        title="qs3 demo: a classifier adapted to a depth camera without labels",
        command=f"qs3 demo --out {folder.name}",
        settings=plain | {"runs": page.settings},
    )
