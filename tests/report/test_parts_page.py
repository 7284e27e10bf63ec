"""The page of answers about known parts: its order, its safety, and its labels in a browser."""

import csv

import numpy as np
import pytest

from qs3.report.parts import PartRow, PartsPage, encode_row, render_parts_page, write_parts_page

from ..browser import Browser, until
from .conftest import HOSTILE
from .test_page import Page

NAMES = ("bolt", "=nut")


def cloud(seed, count=60):
    return np.random.default_rng(seed).normal(size=(count, 3)) * 0.02


def row(file, **other):
    edges = np.array([[[0, 0, 0], [0.03, 0, 0]], [[0, 0, 0], [0, 0.01, 0]]], dtype=float)
    return PartRow(
        file,
        **{"class_name": "bolt", "confidence": 0.9, "points": cloud(1), "edges": edges, **other},
    )


ROWS = (
    row("sure.ply", confidence=0.99, residual=0.0012, visible=0.4),
    row("unsure, perhaps.ply", confidence=0.45, class_name="=nut"),
    row("-lost.ply", state="lost: no pose is good", confidence=1.0),
    PartRow("broken.ply", state="broken.ply: holds no point"),
)
PAGE = PartsPage("Four scans", "By a test.", NAMES, ROWS)


def test_doubtful_scans_come_first():
    page = Page(render_parts_page(PAGE))
    order = [a["data-file"] for name, a in page.tags if name == "div" and "data-file" in a]
    assert order == ["broken.ply", "-lost.ply", "unsure, perhaps.ply", "sure.ply"]
    doubt = [a["data-file"] for name, a in page.tags if (a.get("class") or "") == "scan doubt"]
    assert doubt == order[:3]


def test_scans_in_doubt_are_not_counted_as_their_class():
    text = " ".join("".join(Page(render_parts_page(PAGE)).words).split())
    assert "bolt 1" in text
    assert "=nut 1" in text
    assert "in doubt 3" in text


def test_hostile_names_are_text():
    hostile = PartsPage(
        HOSTILE, HOSTILE, (HOSTILE,), [row(HOSTILE, class_name=HOSTILE, cad=HOSTILE)]
    )
    page = Page(render_parts_page(hostile))
    assert len(page.named("script")) == len(page.named("style")) == 1
    assert not any(key.startswith("on") for _, attributes in page.tags for key in attributes)
    assert HOSTILE in "\n".join(page.words)


def test_points_and_edges_share_one_scale():
    """The longest edge of 30 mm stays 30 mm against the points around it."""
    import base64

    data = encode_row(row("a.ply"))
    edges = np.frombuffer(base64.b64decode(data["edges"]), "<i2").reshape(-1, 2, 3) / 32767
    length = np.linalg.norm(edges[:, 1] - edges[:, 0], axis=1) * float(data["scale"])
    np.testing.assert_allclose(length, [30, 10], atol=0.02)


def test_viewer_stands_where_the_camera_stood():
    """Of two points on the line of sight the nearer one is nearer, and both lie in one place."""
    import base64

    points, camera = np.array([[0.0, 0, 0], [0.1, 0, 0.1]]), np.array([1.0, 0, 1.0])
    data = encode_row(PartRow("a.ply", points=points, camera=camera))
    seen = np.frombuffer(base64.b64decode(data["points"]), "<i2").reshape(-1, 3)
    assert np.abs(seen[0, :2] - seen[1, :2]).max() <= 1
    assert seen[1, 2] > seen[0, 2]


def test_same_page_same_bytes(tmp_path):
    for name in ("a.html", "b.html"):
        write_parts_page(tmp_path / name, PAGE)
    assert (tmp_path / "a.html").read_bytes() == (tmp_path / "b.html").read_bytes()


@pytest.fixture(scope="module")
def browser(tmp_path_factory):
    browser = Browser(tmp_path_factory.mktemp("profile"))
    yield browser
    browser.close()


def test_chosen_classes_are_saved_as_labels(browser, tmp_path):
    """The file holds what `--labels` reads: names with commas and formulas stay names."""
    from qs3.escapes import plain

    write_parts_page(tmp_path / "page.html", PAGE)
    browser.call("Browser.setDownloadBehavior", behavior="allow", downloadPath=str(tmp_path))
    browser.open((tmp_path / "page.html").as_uri())
    assert browser.run("document.getElementById('save').disabled") is True
    for number, name in ((0, "bolt"), (1, "=nut")):
        browser.run(
            f"(() => {{ const s = document.querySelectorAll('.scan select')[{number}];"
            f"s.value = '{name}'; s.dispatchEvent(new Event('change')); }})()"
        )
    browser.run("document.getElementById('save').click()")
    until(lambda: (tmp_path / "labels.csv").exists())
    with (tmp_path / "labels.csv").open(newline="", encoding="utf-8") as file:
        rows = [{key: plain(value) for key, value in row.items()} for row in csv.DictReader(file)]
    assert rows == [
        {"file": "-lost.ply", "class": "bolt"},
        {"file": "unsure, perhaps.ply", "class": "=nut"},
    ]
    assert browser.faults == []


def test_filter_hides_what_is_sure(browser, tmp_path):
    write_parts_page(tmp_path / "page.html", PAGE)
    browser.open((tmp_path / "page.html").as_uri())
    browser.run(
        "(() => { const s = document.getElementById('filter'); s.value = 'doubt';"
        "s.dispatchEvent(new Event('change')); })()"
    )
    query = "[...document.querySelectorAll('.scan')].filter((s) => !s.hidden).length"
    assert browser.run(query) == 3


@pytest.mark.parametrize("width", [390, 1280])
def test_page_never_scrolls_sideways(browser, tmp_path, width):
    write_parts_page(tmp_path / "page.html", PAGE)
    browser.open((tmp_path / "page.html").as_uri())
    screen = {"width": width, "height": 700, "deviceScaleFactor": 1, "mobile": width < 500}
    browser.call("Emulation.setDeviceMetricsOverride", **screen)
    root = "document.documentElement"
    assert browser.run(f"{root}.scrollWidth - {root}.clientWidth") == 0
    browser.call("Emulation.clearDeviceMetricsOverride")
