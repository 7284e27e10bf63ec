"""``qs3 view``: look at a data set, a run's answers, or a mesh that is scanned live."""

import contextlib
import sys
import threading
from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from qs3.errors import InputError, UnevenSizesError
from qs3.sensor.settings import ScanSettings

if TYPE_CHECKING:
    from qs3.io.clouds import PointClouds, UnlabelledClouds
    from qs3.training import LoadedModel
    from qs3.viewer import Answers, Exhibit, ScanRequest

_SHOWN_POINTS = 2048  # of a cloud, where the clouds of a data set differ in size
_DRAWS = 100  # of a built-in class to step through
_RUN_FILES = ("settings.json", "model.safetensors")

Page = Callable[[Any], AbstractContextManager[Any]]
"""Puts a page's controls on a server, until its block ends."""


@dataclass(frozen=True)
class ViewOptions:
    """Look at a data set, a run's answers, or a mesh that is scanned live, in a browser."""

    what: Annotated[str, tyro.conf.Positional]
    """A data set (any that qs3 train reads), a run of qs3 train, a mesh file, a cloud, or a
    built-in class (chair, …)."""
    data: str | None = None
    """With a run: the clouds to predict on; labels that lie there are shown, not used."""
    split: str | None = None
    """Part of the data, such as test; all of it by default."""
    cloud: Literal["points", "clean", "surface"] = "points"
    """With a run on generated data: the cloud that the network is shown."""
    class_name: str | None = None
    """Show the objects of this class first."""
    up: Literal["z", "y"] | None = None
    """Up axis of a mesh file; by default y for glTF, z for all others."""
    host: str = "127.0.0.1"
    """Address or name to listen on. Anybody who reaches another than 127.0.0.1 sees the data."""
    port: int = 8080
    """Port to listen on; 0 takes a free one."""
    scan: Annotated[ScanSettings, tyro.conf.arg(name="")] = field(default_factory=ScanSettings)
    """With a mesh: how it is scanned to start with; a built-in class is drawn by the seed too."""


def view(options: Annotated[ViewOptions, tyro.conf.arg(name="")]) -> int:
    """Look at data, a run or a mesh in a browser on this machine, until Ctrl-C."""
    from qs3.viewer import bind, is_loopback, require_viser, serve, url_of

    require_viser()
    listener = bind(options.host, options.port)
    with contextlib.closing(listener):
        prepared = _prepare(options)
        title = f"qs3 view · {Path(options.what).name}"
        with serve(listener, title, options.host) as server, prepared(server):
            if not is_loopback(listener.getsockname()[0]):
                print(
                    f"qs3: warning: listening on {options.host}: anybody who can reach this machine"
                    " can see the data; leave --host out to keep it to yourself",
                    file=sys.stderr,
                )
            print(url_of(listener), flush=True)
            print("open this address in a browser; Ctrl-C ends it", file=sys.stderr, flush=True)
            with contextlib.suppress(KeyboardInterrupt):
                never = threading.Event()
                while not never.wait(1.0):  # in steps: some systems do not wake a wait without end
                    pass
            print("stopped", file=sys.stderr)
    return 0


def _prepare(options: ViewOptions) -> Page:
    """Read all that the page needs, so that a fault shows before anything is served."""
    from qs3 import shapes
    from qs3.io import read_cloud
    from qs3.io.point_files import POINT_FILES
    from qs3.meshes.loading import EXTENSIONS
    from qs3.viewer import gallery_page, single

    path = Path(options.what)
    if options.what in shapes.CLASSES and not path.exists():
        _refuse_data(options)
        return _mesh_page(options, None)
    if "://" not in options.what and not path.exists():
        raise InputError(
            f"{options.what}: no such file or folder, nor a built-in class "
            f"({', '.join(shapes.CLASSES)})"
        )
    if path.suffix == ".safetensors" or any((path / name).is_file() for name in _RUN_FILES):
        return _run_page(options, path)
    _refuse_data(options)
    ending = path.suffix.lower()
    if path.is_file() and ending in EXTENSIONS:
        from qs3.meshes import load_mesh

        try:
            return _mesh_page(options, load_mesh(path, options.up))
        except InputError:
            if ending not in POINT_FILES:
                raise
            # A PLY without faces is a cloud; any other fault is told by the reader of clouds.
    if path.is_file() and ending in POINT_FILES:
        exhibits = single(path.name, read_cloud(path))
        return partial(gallery_page, exhibits=exhibits, class_name=options.class_name)
    return _data_page(options)


def _data_page(options: ViewOptions) -> Page:
    from qs3.viewer import ArrayExhibits, StoreExhibits, gallery_page

    if _is_store(options.what):
        exhibits = StoreExhibits(options.what, options.split)
    else:
        try:
            clouds = _read(options.what, options.split, None)
        except UnevenSizesError:
            print(
                f"{options.what}: clouds of several sizes, shown with {_SHOWN_POINTS} points each",
                file=sys.stderr,
            )
            clouds = _read(options.what, options.split, _SHOWN_POINTS)
        exhibits = ArrayExhibits.of(clouds)
    return partial(gallery_page, exhibits=exhibits, class_name=options.class_name)


def _run_page(options: ViewOptions, run: Path) -> Page:
    from qs3.training import load_model
    from qs3.viewer import ArrayExhibits, StoreExhibits, gallery_page

    if options.data is None:
        raise InputError(f"{run}: is a run; name the clouds to predict on with --data")
    loaded = load_model(run)
    try:
        points = int(loaded.settings["train"]["num_points"])
    except (KeyError, TypeError, ValueError):
        raise InputError(f"{run}: not a finished run of qs3 train (no num_points in it)") from None
    names = loaded.class_names
    clouds = _read(options.data, options.split, points, options.cloud, names)
    answers = _answers(loaded, clouds, options.cloud)
    if _is_store(options.data):
        exhibits = StoreExhibits(options.data, options.split)
    else:
        exhibits = ArrayExhibits.of(clouds)
    return partial(gallery_page, exhibits=exhibits, answers=answers, class_name=options.class_name)


def _answers(
    loaded: "LoadedModel", clouds: "PointClouds | UnlabelledClouds", cloud: Any
) -> "Answers":
    import numpy as np
    from tqdm import tqdm

    from qs3.io.clouds import PointClouds
    from qs3.training import predict_probabilities
    from qs3.viewer import Answers

    parts = []
    for start in tqdm(range(0, len(clouds), 32), "predict", unit="batch", disable=None):
        batch = clouds.points[start : start + 32]
        parts.append(predict_probabilities(loaded.model, batch))
    truth = clouds.labels if isinstance(clouds, PointClouds) else None
    return Answers(np.concatenate(parts), loaded.class_names, truth, cloud)


def _mesh_page(options: ViewOptions, mesh: Any) -> Page:
    """Scan ``mesh`` live; None is the built-in class that the options name."""
    from qs3 import shapes
    from qs3.sensor.presets import SENSORS
    from qs3.viewer import ScanControls, rescan, scan_page

    how = options.scan
    sensor = how.make_sensor()
    renderer: Any = how.make_renderer()
    start = ScanControls.of(
        sensor,
        views=how.views,
        view_layout=how.chosen("view_layout"),
        num_points=how.num_points,
        samples=renderer.samples,
        crop=how.chosen("crop"),
        seed=how.seed,
    )
    name = Path(options.what).name

    def scan(request: "ScanRequest") -> "Exhibit":
        built_in = mesh is None
        shape = shapes.make(options.what, seed=request.draw) if built_in else mesh
        title = f"{name}, draw {request.draw}" if built_in else name
        return rescan(request, shape, title, renderer, how.chosen("size"))

    others = {key: value for key, value in SENSORS.items() if key != sensor.name}
    return partial(
        scan_page,
        scan=scan,
        sensors={sensor.name: sensor} | others,
        start=start,
        draws=_DRAWS if mesh is None else 0,
        draw=how.seed if mesh is None else 0,
    )


def _read(
    source: str,
    split: str | None,
    num_points: int | None,
    cloud: Any = "points",
    class_names: tuple[str, ...] | None = None,
) -> "PointClouds | UnlabelledClouds":
    """Read clouds with their labels, or without where they have none."""
    from qs3.io import load_clouds, load_unlabelled

    given: dict[str, Any] = {"split": split, "num_points": num_points, "cloud": cloud}
    try:
        return load_clouds(source, class_names=class_names, **given)
    except InputError as error:
        if "has no labels" not in str(error):
            raise
    return load_unlabelled(source, **given)


def _is_store(source: str) -> bool:
    return "://" in source or (Path(source) / "dataset.json").is_file()


def _refuse_data(options: ViewOptions) -> None:
    if options.data is not None:
        raise InputError(f"--data goes with a run of qs3 train, and {options.what} is none")
