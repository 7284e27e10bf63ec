"""``qs3 view``: look at a data set, a run's answers, or a mesh that is scanned live."""

import contextlib
import sys
import threading
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from qs3.sensor.settings import ScanSettings

if TYPE_CHECKING:
    from collections.abc import Callable

    from qs3.viewer.exhibits import Exhibit
    from qs3.viewer.scan_controls import ScanRequest

_DRAWS = 100  # of a built-in class to step through


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
    port: int = 8080
    """Port of 127.0.0.1 to listen on; 0 takes a free one."""
    scan: Annotated[ScanSettings, tyro.conf.arg(name="")] = field(default_factory=ScanSettings)
    """With a mesh: how it is scanned to start with; a built-in class is drawn by the seed too."""


def view(options: Annotated[ViewOptions, tyro.conf.arg(name="")]) -> int:
    """Look at data, a run or a mesh in a browser on this machine, until Ctrl-C."""
    from qs3.viewer.serving import require_free, require_viser, serve, tunnel_of, url_of

    require_viser()
    require_free(options.port)
    page = prepare(options)
    with serve(options.port, f"qs3 view · {Path(options.what).name}") as server, page(server):
        print(url_of(server), flush=True)
        print(
            "open this address in a browser; Ctrl-C ends it. From another machine, first: "
            f"{tunnel_of(server)}",
            file=sys.stderr,
            flush=True,
        )
        with contextlib.suppress(KeyboardInterrupt):
            never = threading.Event()
            while not never.wait(1.0):  # in steps: some systems do not wake a wait without end
                pass
        print("stopped", file=sys.stderr)
    return 0


def prepare(options: ViewOptions) -> "Callable[[Any], AbstractContextManager[Any]]":
    """Read all that the page needs, so that a fault shows before anything is served."""
    from qs3 import shapes
    from qs3.viewer.opening import open_exhibits, open_mesh, refuse_data
    from qs3.viewer.pages import gallery_page

    built_in = options.what in shapes.CLASSES and not Path(options.what).exists()
    mesh = None if built_in else open_mesh(options.what, options.up)
    if built_in or mesh is not None:
        refuse_data(options.what, options.data)
        return _scan_page(options, mesh)
    exhibits, answers = open_exhibits(options.what, options.data, options.split, options.cloud)
    return partial(gallery_page, exhibits=exhibits, answers=answers, class_name=options.class_name)


def _scan_page(options: ViewOptions, mesh: Any) -> "Callable[[Any], AbstractContextManager[Any]]":
    """Scan ``mesh`` live; None is the built-in class that the options name."""
    from qs3 import shapes
    from qs3.sensor.presets import SENSORS
    from qs3.viewer.pages import scan_page
    from qs3.viewer.scan_controls import ScanControls, rescan

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
        if mesh is not None:
            return rescan(request, mesh, name, renderer, how.chosen("size"))
        shape = shapes.make(options.what, seed=request.draw)
        return rescan(request, shape, f"{name}, draw {request.draw}", renderer, how.chosen("size"))

    others = {key: value for key, value in SENSORS.items() if key != sensor.name}
    return partial(
        scan_page,
        scan=scan,
        sensors={sensor.name: sensor} | others,
        start=start,
        draws=_DRAWS if mesh is None else 0,
        draw=how.seed if mesh is None else 0,
    )
