"""The page of answers about known parts: its order, its safety, and its labels in a browser."""

import base64
import csv
from pathlib import Path

import numpy as np
import pytest

from qs3.answers.answer import Answer
from qs3.parts.locating import Candidate
from qs3.parts.places import Place
from qs3.parts.symmetry import Symmetry
from qs3.report.parts_page import encode, parts_page, write_parts_page

from ..browser import until
from .conftest import HOSTILE
from .test_page import Page

NAMES = ("bolt", "=nut")


def row(file, name="bolt", share=0.9, lost=False, cad="m8.stl"):
    """An answer of a class with a CAD file."""
    edges = np.array([[[0, 0, 0], [0.03, 0, 0]], [[0, 0, 0], [0, 0.01, 0]]], np.float32)
    points = np.random.default_rng(1).normal(size=(60, 3)) * 0.02
    found = Candidate(name, cad, np.eye(4), Symmetry(np.zeros(3), np.eye(3)[None]), 0.0012, 0.001,
                      0.4, 0.9, 0.001, 1.0, lost=lost)  # fmt: skip
    return Answer(Path(file), {name: share}, candidates=(found,), edges=edges, points=points)


ROWS = (
    row("sure.ply", share=0.99),
    row("unsure, perhaps.ply", "=nut", 0.45),
    row("-lost.ply", share=1.0, lost=True),
    Answer(Path("broken.ply"), fault="broken.ply: holds no point"),
)


def test_doubtful_scans_come_first():
    page = Page(parts_page(ROWS, NAMES))
    order = [a["data-file"] for name, a in page.tags if name == "div" and "data-file" in a]
    assert order == ["broken.ply", "-lost.ply", "unsure, perhaps.ply", "sure.ply"]
    doubt = [a["data-file"] for name, a in page.tags if (a.get("class") or "") == "scan doubt"]
    assert doubt == order[:3]


def test_each_class_counts_the_scans_that_its_filter_shows_and_each_shows_its_cad():
    text = " ".join("".join(Page(parts_page(ROWS, NAMES)).words).split())
    assert "bolt 2" in text
    assert "=nut 1" in text
    assert "in doubt 3" in text
    assert "The number beside a class is its confidence." in text
    assert "sure.plyCAD m8.stl residual 1.2 mm, visible 40 %" in text


def test_scans_that_were_named_one_by_one_keep_their_names():
    rows = [row("scans/a.ply"), row("scans/b.ply")]
    page = Page(parts_page(rows, NAMES, below=rows[0].file))
    names = [a["data-file"] for _, a in page.tags if "data-file" in a]
    assert names == ["scans/a.ply", "scans/b.ply"]


def test_pose_of_a_lost_scan_is_marked_as_not_believed():
    page = Page(parts_page(ROWS, NAMES))
    lost = [a["data-file"] for _, a in page.tags if "data-lost" in a]
    assert lost == ["-lost.ply"]
    text = " ".join("".join(page.words).split())
    assert text.count("lostthe grey pose is not believed") == 1


def test_hostile_names_are_text():
    page = Page(parts_page([row(HOSTILE, HOSTILE, cad=HOSTILE)], (HOSTILE,)))
    assert len(page.named("script")) == len(page.named("style")) == 1
    assert not any(key.startswith("on") for _, attributes in page.tags for key in attributes)
    assert HOSTILE in "\n".join(page.words)


def test_points_and_edges_share_one_scale():
    """The longest edge of 30 mm stays 30 mm against the points around it."""
    data = encode(row("a.ply"))
    edges = np.frombuffer(base64.b64decode(data["edges"]), "<i2").reshape(-1, 2, 3) / 32767
    length = np.linalg.norm(edges[:, 1] - edges[:, 0], axis=1) * float(data["scale"])
    np.testing.assert_allclose(length, [30, 10], atol=0.02)


def test_viewer_stands_where_the_camera_stood():
    """Of two points on the line of sight the nearer one is nearer, and both lie in one place."""
    points = np.array([[0.0, 0, 0], [0.1, 0, 0.1]])
    data = encode(Answer(points=points, place=Place(camera=(1.0, 0.0, 1.0))))
    seen = np.frombuffer(base64.b64decode(data["points"]), "<i2").reshape(-1, 3)
    assert np.abs(seen[0, :2] - seen[1, :2]).max() <= 1
    assert seen[1, 2] > seen[0, 2]


def test_chosen_classes_are_saved_as_labels(browser, tmp_path):
    """The file holds what `--labels` reads: names with commas and formulas stay names."""
    from qs3.escapes import plain

    write_parts_page(tmp_path / "page.html", ROWS, NAMES)
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


def test_labels_that_were_learnt_are_chosen_and_saved_with_the_new_ones(browser, tmp_path):
    """Else a table from the page would replace those of the table before."""
    labels = {"sure.ply": "=nut"}
    write_parts_page(tmp_path / "page.html", ROWS, NAMES, labels=labels)
    browser.call("Browser.setDownloadBehavior", behavior="allow", downloadPath=str(tmp_path))
    browser.open((tmp_path / "page.html").as_uri())
    assert browser.run("document.getElementById('chosen').textContent") == "1 scan has a label."
    assert browser.run("document.querySelector('.labelled').dataset.file") == "sure.ply"
    browser.run(
        "(() => { const s = document.querySelector('.scan select'); s.value = 'bolt';"
        "s.dispatchEvent(new Event('change')); document.getElementById('save').click(); })()"
    )
    until(lambda: (tmp_path / "labels.csv").exists())
    assert (tmp_path / "labels.csv").read_text().splitlines() == [
        "file,class", "'-lost.ply,bolt", "sure.ply,'=nut"
    ]  # fmt: skip


def test_the_page_draws_each_scan_and_its_cad_grey_if_lost(browser, tmp_path):
    """Told by the pixels of the canvas; the dots are blue."""
    write_parts_page(tmp_path / "page.html", [row("a.ply"), row("b.ply", lost=True)], NAMES)
    browser.open((tmp_path / "page.html").as_uri())
    counts = (
        "[...document.querySelectorAll('canvas')].map((c) => { const n = [0, 0, 0], d ="
        "c.getContext('2d').getImageData(0, 0, c.width, c.height).data;"
        "for (let i = 0; i < d.length; i += 4) { const [r, g, b, a] = d.slice(i, i + 4);"
        "n[0] += r == 204 && g == 51 && a == 255; n[1] += r == 136 && b == 136 && a == 255;"
        "n[2] += b > r + 40; } return n.map((count) => count > 20); })"
    )
    until(lambda: all(dots for *_, dots in browser.run(counts)))
    assert browser.run(counts) == [[False, True, True], [True, False, True]]  # the lost one first


def test_filter_hides_what_is_sure(browser, tmp_path):
    write_parts_page(tmp_path / "page.html", ROWS, NAMES)
    browser.open((tmp_path / "page.html").as_uri())
    browser.run(
        "(() => { const s = document.getElementById('filter'); s.value = 'doubt';"
        "s.dispatchEvent(new Event('change')); })()"
    )
    query = "[...document.querySelectorAll('.scan')].filter((s) => !s.hidden).length"
    assert browser.run(query) == 3


@pytest.mark.parametrize("width", [390, 1280])
def test_page_never_scrolls_sideways(browser, tmp_path, width):
    write_parts_page(tmp_path / "page.html", ROWS, NAMES)
    browser.open((tmp_path / "page.html").as_uri())
    screen = {"width": width, "height": 700, "deviceScaleFactor": 1, "mobile": width < 500}
    browser.call("Emulation.setDeviceMetricsOverride", **screen)
    root = "document.documentElement"
    assert browser.run(f"{root}.scrollWidth - {root}.clientWidth") == 0
    browser.call("Emulation.clearDeviceMetricsOverride")
