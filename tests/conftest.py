"""Fixtures for every test."""

import os
import sys

# Before PyTorch loads: test processes share the cores already, and threads that wait for each
# other's core make small networks several times slower.
os.environ.setdefault("OMP_NUM_THREADS", "1")
os.environ.setdefault("GOMP_SPINCOUNT", "1000")

import functools
import gc
import inspect
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType

import jaxtyping
import numpy as np
import pytest
from hypothesis import settings as hypothesis_settings

# Examples of methods outside of qs3.
sys.path.append(str(Path(__file__).parents[1] / "examples" / "methods"))

# A busy machine is no fault: laws are not timed.
hypothesis_settings.register_profile("untimed", deadline=None)
hypothesis_settings.load_profile("untimed")

# No test cuts the power, and each of ten thousand small files would wait for the disk.
os.fsync = os.fstat  # it still refuses what is not open

_FIRST, _EVERY = 1, 200
_started = [0]
"""How many tests have begun."""


def _check_some(every=jaxtyping.jaxtyped):
    """Check the types of each function's first call in each test, and of some that follow.

    All of them would take a fifth of the time of tests that call small functions often. A check is
    made when its function is first called: making those of all functions takes seconds.
    """

    def jaxtyped(*, typechecker):
        decorate = every(typechecker=typechecker)

        def checking(thing):
            if not inspect.isfunction(thing):
                return decorate(thing)
            checked, test, calls = None, 0, 0

            @functools.wraps(thing)
            def called(*arguments, **named):
                __tracebackhide__ = True
                nonlocal checked, test, calls
                if checked is None:
                    checked = decorate(thing)
                if test != _started[0]:
                    test, calls = _started[0], 0
                calls += 1
                chosen = thing if calls > _FIRST and calls % _EVERY else checked
                return chosen(*arguments, **named)

            return called

        return checking

    return jaxtyped


jaxtyping.jaxtyped = _check_some()  # before qs3 is imported


def pytest_runtest_setup():
    _started[0] += 1


_FIRST_ROOMS = ["parts", "sensor", "training", "models", "adaptation", "paper", "workflow", "cli"]
"""The longest first: while one process compiles for ``parts``, no other needs these functions."""


def pytest_collection_modifyitems(items):
    def place(item):
        room = item.nodeid.split("/")[1] if item.nodeid.startswith("tests/") else ""
        return _FIRST_ROOMS.index(room) if room in _FIRST_ROOMS else len(_FIRST_ROOMS)

    items.sort(key=place)


def pytest_collection_finish():
    gc.freeze()  # modules and tests stay to the end: no collection need look through them


@pytest.hookimpl(optionalhook=True)  # as without pytest-xdist
def pytest_xdist_make_scheduler(config, log):
    """With ``--dist loadfile``, keep folders too together whose fixtures take long to make."""
    from xdist.scheduler import LoadFileScheduling

    class LoadFixtures(LoadFileScheduling):
        def _split_scope(self, nodeid: str) -> str:
            folder = "/".join(nodeid.split("/")[:2])
            shared = ("tests/cli", "tests/paper", "tests/parts", "tests/report", "tests/workflow")
            return folder if folder in shared else super()._split_scope(nodeid)

    config.option.loadscopereorder = False  # the order is that of the rooms
    return LoadFixtures(config, log) if config.option.dist == "loadfile" else None


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """Folder of the real meshes and scans; the test is skipped where it is not here."""
    named = os.environ.get("QS3_SHARED_DATA")
    if named:
        folder = Path(named)
        if not folder.is_dir():
            pytest.fail(f"QS3_SHARED_DATA names {folder}, which is no folder")
        return folder
    folder = Path(__file__).resolve().parents[2] / "shared" / "data"
    if not folder.is_dir():
        pytest.skip("no real data here: set QS3_SHARED_DATA to the folder that holds it")
    return folder


@pytest.fixture(scope="session")
def d435_pair(shared_data: Path) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A real D435's left and right image, and the disparity of its own depth, from a picture of it.

    That jet picture runs from blue over cyan and yellow to red in 4 · 254 steps of 1.275 mm from
    199 mm, as a line through the depth that three matchers find in the same pair shows; it is black
    where there is none. f is 427.12 px, b 50 mm.
    """
    import cv2

    left, right, picture = (
        cv2.imread(str(shared_data / "ir" / f"d435_{name}.png"), mode)
        for name, mode in (("left", 0), ("right", 0), ("depth_preview", 1))
    )
    blue, green, red = picture.astype(float).transpose(2, 0, 1)
    place = np.where(red == 0, green, np.where(green >= 254, 254 + (red + 254 - blue) / 2, 0))
    place = np.where((red >= 254) & (green < 254), 762 - green, place)
    place[picture.sum(axis=2) == 0] = np.nan
    camera = 427.12 * 50 / (198.9 + 1.275 * place)
    return left, right, camera.repeat(2, axis=0).repeat(2, axis=1)


@pytest.fixture
def typed(capfd):
    """Runs ``qs3`` in this process."""
    from .commands import Typed

    return Typed(capfd)


@pytest.fixture
def rng() -> np.random.Generator:
    """A generator with a fixed seed, fresh for each test."""
    return np.random.default_rng(20220712)


@pytest.fixture(scope="session")
def source():
    """Small labelled clouds of three shapes."""
    from .training.common import make_clouds

    return make_clouds()


@pytest.fixture(scope="session")
def target():
    """Noisier ones of the same shapes."""
    from .training.common import make_clouds

    return make_clouds(count=30, seed=1, noise=0.1)


@pytest.fixture(scope="session")
def settings():
    """Settings of a small network."""
    from qs3.runs import TrainSettings

    from .training.common import TRAIN

    return TrainSettings(model="pointnet", holdout=0.0, **TRAIN)


@pytest.fixture
def fake(monkeypatch: pytest.MonkeyPatch) -> Iterator[ModuleType]:
    """The module of cheap scans, importable by worker processes too (they inherit the path)."""
    monkeypatch.syspath_prepend(str(Path(__file__).parent / "store"))
    import qs3_fake_scan

    yield qs3_fake_scan
