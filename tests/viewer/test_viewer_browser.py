"""The viewer in a real browser: it connects, draws the cloud, and says nothing on the console."""

import numpy as np
import pytest

from qs3.viewer.exhibits import Answers, ArrayExhibits
from qs3.viewer.pages import gallery_page
from qs3.viewer.serving import serve, url_of

from ..browser import Browser, until

pytest.importorskip("viser", reason="viser is not installed: pip install 'qs3[view]'")


@pytest.fixture
def browser(tmp_path):
    browser = Browser(tmp_path / "profile")
    yield browser
    browser.close()


def test_page_connects_and_draws_without_a_fault(browser, rng):
    """A hostile name stays a name; the violet end of viridis and the yellow one are both drawn."""
    hostile = "<img src=x onerror=\"document.title='run'\">"
    points = rng.uniform(-1, 1, size=(2, 4000, 3)).astype(np.float32)
    items = ArrayExhibits(points, (hostile, "second"), ("bed", hostile))
    with serve(0, "test") as server, gallery_page(server, items) as canvas:
        canvas._mode.value = "height"
        browser.open(url_of(server))
        until(lambda: server.get_clients())

        def drawn():
            pixels = browser.picture()[:, :750].reshape(-1, 3).astype(int)
            ends = (np.array([68, 1, 84]), np.array([253, 231, 37]))
            return all((np.abs(pixels - end).max(axis=1) < 40).sum() > 100 for end in ends)

        until(drawn)
        until(lambda: hostile in browser.run("document.body.innerText"))
        for handle in server.gui._gui_input_handle_from_uuid.values():
            if handle.label == "Object":
                handle.value = 2
        until(lambda: "second" in browser.run("document.body.innerText"))
        assert browser.run("document.title") != "run"
    # The page tells that the server has gone: that is no fault of its own.
    assert browser.faults == []


@pytest.mark.parametrize("width", [390, 1280])
def test_points_have_the_colour_of_the_legend(browser, rng, width):
    """To the grey level, at the size of a phone too, but for the smoothed rims of points."""
    points = rng.uniform(-1, 1, size=(1, 1500, 3)).astype(np.float32)
    answers = Answers(np.array([[0.1, 0.9]]), ("bed", "chair"), np.array([1]))
    screen = {"width": width, "height": 800, "deviceScaleFactor": 1, "mobile": width < 500}
    browser.call("Emulation.setDeviceMetricsOverride", **screen)
    items = ArrayExhibits(points, ("one",), ("chair",))
    with serve(0, "test") as server, gallery_page(server, items, answers) as canvas:
        canvas._mode.value = "right or wrong"
        browser.open(url_of(server))
        until(lambda: server.get_clients())

        def coloured():
            pixels = browser.picture()[60:300, : min(width, 750)].reshape(-1, 3).astype(int)
            return pixels[np.ptp(pixels, axis=1) > 30]

        until(lambda: len(coloured()) > 1000)
        until(lambda: "right: chair" in browser.run("document.body.innerText"))
        assert np.median(coloured(), axis=0).tolist() == [0x11, 0x77, 0x33]
        swatch = "[...document.querySelectorAll('span')].map((s) => s.style.background)"
        assert "rgb(17, 119, 51)" in browser.run(swatch)
        assert "ground: squares of 0.5" in browser.run("document.body.innerText")
