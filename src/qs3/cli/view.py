"""``qs3 view``: look at a data set, a run's answers, or a mesh that is scanned live."""

import contextlib
import threading
from contextlib import AbstractContextManager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from qs3.cli.options import Flat
from qs3.cli.text import show, tell
from qs3.sensor.settings import ScanSettings

if TYPE_CHECKING:
    from collections.abc import Callable

    from qs3.viewer.exhibits import Exhibit

_DRAWS = 100  # of a built-in class to step through


def view(
    what: Annotated[str, tyro.conf.Positional],
    data: str | None = None,
    split: str | None = None,
    cloud: Literal["points", "clean", "surface"] = "points",
    class_name: str | None = None,
    up: Literal["z", "y"] | None = None,
    port: int = 8080,
    settings: Flat[ScanSettings] = ScanSettings(),  # noqa: B008
) -> int:
    """Look at data, a run or a mesh in a browser on this machine, until Ctrl-C.

    Args:
        what: A data set (any that qs3 train reads), a run of qs3 train, a mesh file, a cloud, or a
            built-in class (chair, …).
        data: With a run: the clouds to predict on; labels that lie there are shown, not used.
        split: Part of the data, such as test; all of it by default.
        cloud: With a run on generated data: the cloud that the network is shown.
        class_name: Show the objects of this class first; of a mesh file, its class.
        up: Up axis of a mesh file; by default y for glTF, z for all others.
        port: Port of 127.0.0.1 to listen on; 0 takes a free one.
        settings: With a mesh: how it is scanned to start with; the seed draws a built-in class.
    """
    from qs3.viewer.opening import open_exhibits
    from qs3.viewer.pages import gallery_page
    from qs3.viewer.serving import require_free, require_viser, serve, tunnel_of, url_of

    require_viser()
    require_free(port)
    # All is read before anything is served, so that a fault shows in time.
    page = _scan_page(what, data, up, class_name or "", settings)
    if page is None:
        exhibits, answers = open_exhibits(what, data, split, cloud)
        page = partial(gallery_page, exhibits=exhibits, answers=answers, class_name=class_name)
    with serve(port, f"qs3 view · {Path(what).name}") as server, page(server):
        show(url_of(server))
        hint = f"From another machine, first: {tunnel_of(server)}"
        tell(f"open it in a browser; Ctrl-C ends it. {hint}")
        with contextlib.suppress(KeyboardInterrupt):
            never = threading.Event()
            while not never.wait(1.0):  # in steps: some systems do not wake a wait without end
                pass
        tell("stopped")
    return 0


def _scan_page(
    what: str, data: str | None, up: Any, class_name: str, settings: ScanSettings
) -> "Callable[[Any], AbstractContextManager[Any]] | None":
    """The page of a mesh file or a built-in class, scanned live; None for anything else."""
    from qs3 import shapes
    from qs3.viewer.opening import open_mesh, refuse_data
    from qs3.viewer.pages import scan_page
    from qs3.viewer.scan_controls import rescan, resolve

    name, built_in = Path(what).name, what in shapes.CLASSES and not Path(what).exists()
    mesh = None if built_in else open_mesh(what, up)
    if mesh is None and not built_in:
        return None
    refuse_data(what, data)

    def scan(settings: ScanSettings, draw: int) -> "Exhibit":
        if mesh is not None:
            return rescan(settings, mesh, name, class_name)
        return rescan(settings, shapes.make(what, seed=draw), f"{name}, draw {draw}", what)

    start = resolve(settings)
    return partial(scan_page, scan=scan, start=start, draws=_DRAWS if built_in else 0)
