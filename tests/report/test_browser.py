"""The page in a real browser: no error, and the clouds turn."""

import re

import pytest


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
    """The domain with fewer clouds of the class begins again."""

    def shown():
        query = "[...document.querySelectorAll('figcaption')].map((f) => f.textContent)"
        return [re.sub(r"\. qbst.*", "", text, flags=re.S) for text in page.run(query)]

    def press(button):
        page.run(f"document.querySelectorAll('#viewer button')[{button}].click()")

    assert shown() == ["bed 1 of 2", "bed 1 of 1"]
    press(1)
    assert shown() == ["bed 2 of 2", "bed 1 of 1"]
    press(0)
    press(0)
    assert shown() == ["bed 2 of 2", "bed 1 of 1"]
    page.run(
        "(() => { const s = document.querySelector('#viewer select'); s.value = '2';"
        "s.dispatchEvent(new Event('change')); })()"
    )
    assert shown() == ["table 1 of 2", "table 1 of 1"]


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
        mouse = f"{{ buttons: {buttons}, movementX: 40 }}"
        return f"c.dispatchEvent(new PointerEvent('pointermove', {mouse}))"

    first = look("")
    second = look(drag(1))
    third = look("c.dispatchEvent(new KeyboardEvent('keydown', {key: 'ArrowUp'}))")
    blank = page.run(
        "(() => { const b = document.createElement('canvas'), c = document.querySelector('canvas');"
        "b.width = b.height = c.width; return b.toDataURL(); })()"
    )
    assert len({blank, first, second, third}) == 4
    assert look(drag(0)) == third
