"""Step through clouds in a browser on this machine, by viser (extra ``view``)."""

import contextlib
import dataclasses
import functools
import html
import sys
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from jaxtyping import Float, Float32, UInt8

from qs3.answers.answer import answer, load_trained
from qs3.answers.cloud_files import ListedCloud, as_read, read_listed
from qs3.clouds.files import POINT_FILES
from qs3.clouds.load import read_clouds
from qs3.clouds.types import CloudKind
from qs3.errors import InputError, MissingCloudsError, MissingExtraError
from qs3.runs.bundled import find_run, shipped
from qs3.runs.loaded import Loaded
from qs3.runs.run import is_run, weights_file

HOST = "127.0.0.1"
KINDS: dict[CloudKind, str] = {"points": "scan", "clean": "clean twin", "surface": "surface"}
_GAP = 1.3  # from one cloud to the next, in lengths of the object
_POINT = 0.012
_Answer = Callable[[ListedCloud], Mapping[str, float]]
_MAP = matplotlib.colormaps["viridis"]


@dataclass(frozen=True)
class Items:
    """Objects to step through."""

    names: tuple[str, ...]
    clouds: Mapping[CloudKind, Sequence[Float[np.ndarray, "_ 3"]]]
    """The clouds of all objects, by kind; there are always scans."""
    labels: tuple[str, ...] = ()
    """Classes by name; empty if the data has no labels."""
    answer: _Answer | None = None
    """Return the probabilities that a run gives to a cloud, the largest first."""
    listed: Sequence[ListedCloud] = ()
    """The scans as a run answers them."""
    faults: tuple[str, ...] = ()
    """Faults of files that cannot be read; they are no items."""

    def __len__(self) -> int:
        return len(self.names)

    def text(self, row: int) -> str:
        """Return number, name, label and answer of an object as HTML; names are escaped."""
        lines = [f"{row + 1} of {len(self)}: {self.names[row]}"]
        if self.labels:
            lines.append(f"label: {self.labels[row]}")
        if self.answer is not None:
            try:
                shares_by_name = self.answer(self.listed[row])
                shares = list(shares_by_name.items())[:3]
                text = ", ".join(f"{name} {share:.1%}" for name, share in shares)
            except InputError as error:  # the page shows the fault
                text = str(error)
            lines.append(f"answer: {text}")
        return as_html(lines)


def as_html(lines: Iterable[str]) -> str:
    """Return lines of text as HTML; what is markup in them is escaped."""
    body = "<br>".join(map(html.escape, lines))
    return f'<div style="padding:0.4em 0.9em;overflow-wrap:anywhere">{body}</div>'


def open_items(what: str, data: str | None = None, split: str | None = None) -> Items:
    """Read a data set, one cloud, or the data that a run shall answer for.

    Args:
        what: Data set of any layout, file of points, or run (folder, file or name).
        data: With a run: the clouds to predict.
        split: Part of the data.
    """
    path = find_run(what)
    if not path.exists():
        raise InputError(
            f"{what}: no such file or folder, nor a network that comes with qs3 "
            f"({', '.join(shipped())})"
        )
    has_weights = path.is_dir() and weights_file(path) is not None
    if has_weights or path.suffix == ".safetensors" or is_run(path):
        if data is None:
            raise InputError(f"{what}: is a run; name the clouds to predict with --data")
        loaded, items = load_trained(path), open_items(data, split=split)
        return dataclasses.replace(items, answer=functools.partial(_answer, loaded))
    if data is not None:
        raise InputError(f"--data goes with a run of qs3 train, and {what} is none")
    if path.is_file() and path.suffix.lower() in POINT_FILES:
        listed = read_listed(path)
        return Items((path.name,), {"points": [listed[0].points]}, listed=listed)
    faults: list[InputError] = []
    read, layout = read_clouds(path, split, faults=faults)
    clouds: dict[CloudKind, Any] = {"points": read.clouds}
    for kind in ("clean", "surface") if layout == "store" else ():
        with contextlib.suppress(MissingCloudsError):
            clouds[kind] = read_clouds(path, split, kind)[0].clouds
    named = () if read.labels is None else tuple(read.class_names[row] for row in read.labels)
    listed = as_read(read, Path())
    return Items(read.ids, clouds, named, listed=listed, faults=tuple(map(str, faults)))


def _answer(loaded: Loaded, cloud: ListedCloud) -> Mapping[str, float]:
    (single,) = answer(loaded, [cloud])
    if single.fault:
        raise InputError(single.fault)
    return single.probabilities


def place(
    clouds: Sequence[Float[np.ndarray, "_ 3"]],
) -> list[Float32[np.ndarray, "_ 3"]]:
    """Put clouds of one object beside each other, the longest side of all of them being 1.

    Example:
        >>> line = np.array([[0.0, 0, 0], [0, 0, 4]])
        >>> [cloud[:, 0].tolist() for cloud in place([line, line])]
        [[0.0, 0.0], [1.2999999523162842, 1.2999999523162842]]
    """
    whole = np.concatenate(list(clouds))
    low, high = whole.min(axis=0), whole.max(axis=0)
    side = max(float((high - low).max()), 1e-9)
    return [
        ((cloud - (low + high) / 2) / side + [_GAP * column, 0, 0]).astype(np.float32)
        for column, cloud in enumerate(clouds)
    ]


def height_colours(points: Float[np.ndarray, "n 3"]) -> UInt8[np.ndarray, "n 3"]:
    """Colour points by z, from the lowest (violet) to the highest (yellow)."""
    height = points[:, 2] - points[:, 2].min()
    return np.asarray(_MAP(height / max(float(height.max()), 1e-9), bytes=True))[:, :3]


class Page:
    """The page: an object's clouds side by side, its label and answer, and two buttons."""

    def __init__(self, server: Any, items: Items) -> None:
        self._server, self._items, self.row = server, items, 0
        columns = len(items.clouds)
        server.initial_camera.position = (_GAP * (columns - 1) / 2, -1.2 - 0.9 * columns, 0.8)
        server.initial_camera.look_at = (_GAP * (columns - 1) / 2, 0.0, 0.0)
        self.text = server.gui.add_html("")
        self.previous, self.next = (server.gui.add_button(name) for name in ("Previous", "Next"))
        self._lock = threading.Lock()  # viser runs each click in a thread of its own
        self.previous.on_click(lambda _: self._step(-1))
        self.next.on_click(lambda _: self._step(1))
        self.show(0)

    def _step(self, by: int) -> None:
        with self._lock:
            self.show(self.row + by)

    def show(self, row: int) -> None:
        """Show an object; after the last comes the first."""
        row %= len(self._items)
        clouds: dict[CloudKind, Any] = {
            kind: of[row][np.isfinite(of[row]).all(axis=1)]
            for kind, of in self._items.clouds.items()
        }
        placed = place(list(clouds.values()))
        text = self._items.text(row)
        with self._server.atomic():
            for column, (kind, points) in enumerate(zip(clouds, placed, strict=True)):
                colours = height_colours(points)
                self._server.scene.add_point_cloud(
                    f"/{kind}", points, colours, point_size=_POINT, point_shading="flat"
                )
                title = f"{KINDS[kind]} ({len(points)} points)"
                self._server.scene.add_label(
                    f"/{kind}-title", title, position=(_GAP * column, 0.0, 0.65)
                )
            self.text.content = text
        self.row = row


@contextlib.contextmanager
def serve(items: Items, port: int) -> Iterator[tuple[str, Page]]:
    """Serve the page on 127.0.0.1 until the block ends; yield its address and the page."""
    with serving(port, "qs3 view") as (address, server):
        yield address, Page(server, items)


def wait() -> None:
    """Wait until Ctrl-C: in steps, as some systems do not wake a wait without end."""
    forever = threading.Event()
    while not forever.wait(1.0):
        pass


@contextlib.contextmanager
def serving(port: int, label: str) -> Iterator[tuple[str, Any]]:
    """Serve an empty page on 127.0.0.1 until the block ends; yield its address and the server.

    If the port is in use, the next free one is taken; 0 takes any.
    """
    try:
        import viser
    except ImportError as error:
        raise MissingExtraError("viser", "view") from error
    with contextlib.redirect_stdout(sys.stderr):  # viser prints where it listens, and that it ends
        server = viser.ViserServer(HOST, port, label=label, verbose=False)
    try:
        server.gui.configure_theme(show_logo=False, show_share_button=False)
        yield f"http://{HOST}:{server.get_port()}", server
    finally:
        with contextlib.redirect_stdout(sys.stderr):
            server.stop()
