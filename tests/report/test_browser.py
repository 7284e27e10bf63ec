"""The page in a real browser: no error, and the clouds turn."""

import re

import numpy as np
import pytest

from ..browser import Browser
from .conftest import HOSTILE


@pytest.fixture(scope="module")
def browser(page_path, tmp_path_factory):
    browser = Browser(tmp_path_factory.mktemp("profile"))
    yield browser
    browser.close()


@pytest.fixture
def page(browser, page_path):
    """The page, opened anew; nothing on it may be a fault."""
    browser.open(page_path.as_uri())
    yield browser
    assert browser.faults == []


def test_the_policy_lets_the_page_draw_its_clouds(page):
    assert page.run("document.getElementById('viewer').hidden") is False
    wait = "new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))"
    seen = "[...document.querySelectorAll('canvas')].filter((c) => c.offsetParent)"
    sizes = f"{seen}.map((c) => [c.width, c.height])"
    sizes = page.run(f"{wait}.then(() => {sizes})")
    assert len(sizes) == 2
    assert all(width == height > 100 for width, height in sizes)


def test_reader_steps_through_the_clouds_of_a_class(page):
    """All classes at first; the domain with fewer clouds of a class begins anew."""

    def shown():
        panel = "document.querySelector('#panel-1')"
        query = f"[...{panel}.querySelectorAll('figcaption')].map((f) => f.textContent)"
        captions = [re.sub(r" *Taken.*", "", caption, flags=re.S) for caption in page.run(query)]
        return captions, page.run(f"{panel}.querySelector('output').textContent")

    def press(button):
        page.run(f"document.querySelectorAll('#panel-1 button')[{button}].click()")

    assert shown() == (["bed 1 of 2.", "bed 1 of 1."], "1 of 6")
    press(1)
    assert shown() == (["bed 2 of 2.", "bed 1 of 1."], "2 of 6")
    press(0)
    press(0)
    assert shown() == (["table 2 of 2.", "table 1 of 1."], "6 of 6")
    page.run(
        "(() => { const s = document.querySelector('#viewer select'); s.value = '0';"
        "s.dispatchEvent(new Event('change')); })()"
    )
    assert shown() == (["bed 1 of 2.", "bed 1 of 1."], "1 of 2")


def test_tabs_show_pairs_side_by_side_under_their_headings(page):
    """Mistakes keep their order, each beside its own nearest scan, whatever its class."""
    panel = "document.querySelector('#panel-2')"
    assert page.run(f"{panel}.offsetParent === null")
    page.run("document.querySelector('#tab-2').click()")
    assert not page.run(f"{panel}.offsetParent === null")
    seen = []
    for _ in range(2):
        query = f"[...{panel}.querySelectorAll('figcaption')].map((f) => f.textContent)"
        seen.append([re.split(r"[ .]", caption)[0] for caption in page.run(query)])
        page.run(f"{panel}.querySelector('[data-step=\"1\"]').click()")
    assert seen == [["chair", "bed"], ["table", "chair"]]
    headings = page.run("[...document.querySelectorAll('figure h3, figure h4')].filter("
                        "(h) => h.offsetParent).map((h) => h.textContent)")  # fmt: skip
    assert headings[:4] == [
        "One view through the simulated sensor", "The cloud of all views", "source",
        f"target {HOSTILE}",
    ]  # fmt: skip
    assert headings[4:] == [f"scan {HOSTILE}", "source"]


def test_clouds_are_large_and_dark_and_stand_on_ground(page):
    """The cloud takes most of its canvas, in its middle; the ground is lighter than any point."""
    page.run("document.querySelector('#tab-1').click()")
    wait = "new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))"
    read = "c.getContext('2d').getImageData(0, 0, c.width, c.height).data"
    pixels = page.run(f"{wait}.then(() => {{ const c = document.querySelector('canvas'); "
                      f"return [c.width, Array.from({read})]; }})")  # fmt: skip
    colours = np.array(pixels[1], np.uint8).reshape(pixels[0], pixels[0], 4)
    drawn = colours[..., 3] > 200
    grey = (np.ptp(colours[..., :3].astype(int), axis=2) < 8) & drawn
    assert grey.sum() > 500  # the ground
    rows, columns = np.nonzero(drawn & (np.ptp(colours[..., :3].astype(int), axis=2) > 40))
    assert np.ptp(rows) > 0.5 * pixels[0]
    assert abs((rows.max() + rows.min()) / 2 - pixels[0] / 2) < 0.15 * pixels[0]
    assert abs((columns.max() + columns.min()) / 2 - pixels[0] / 2) < 0.15 * pixels[0]
    assert colours[rows, columns, :3].min(axis=1).max() < 150


@pytest.mark.parametrize("width", [390, 1280])
def test_body_never_scrolls_sideways(page, width):
    """On a phone and on a desk, with every part unfolded; and no table by a few pixels."""
    screen = {"width": width, "height": 700, "deviceScaleFactor": 1, "mobile": width < 500}
    page.call("Emulation.setDeviceMetricsOverride", **screen)
    page.run("document.querySelectorAll('details').forEach((d) => { d.open = true; })")
    root = "document.documentElement"
    assert page.run("innerWidth") == width
    assert page.run(f"{root}.scrollWidth - {root}.clientWidth") == 0
    query = (
        "[...document.querySelectorAll('.scroll, pre')].map((t) => t.scrollWidth - t.clientWidth)"
    )
    assert page.run(query) == [0] * len(page.run(query))
    page.call("Emulation.clearDeviceMetricsOverride")


def test_clouds_turn_under_the_hand(page):
    """A drag changes the picture, and so does an arrow key: told by the canvas's own pixels."""

    def look(event):
        wait = "requestAnimationFrame(() => requestAnimationFrame(() => done(c.toDataURL())))"
        return page.run(
            f"new Promise((done) => {{ const c = document.querySelector('canvas'); {event}; "
            f"{wait}; }})"
        )

    def drag(buttons):
        how = f"{{ buttons: {buttons}, movementX: 40 }}"
        return f"c.dispatchEvent(new PointerEvent('pointermove', {how}))"

    first = look("")
    second = look(drag(1))
    third = look("c.dispatchEvent(new KeyboardEvent('keydown', {key: 'ArrowUp'}))")
    blank = page.run(
        "(() => { const b = document.createElement('canvas'), c = document.querySelector('canvas');"
        "b.width = b.height = c.width; return b.toDataURL(); })()"
    )
    assert len({blank, first, second, third}) == 4
    assert look(drag(0)) == third
