import base64
import dataclasses
import hashlib
import io
import re
from html.parser import HTMLParser

import numpy as np
import pytest
from matplotlib.image import imread

from qs3.report.page import encode_points, render, write_report

from .conftest import HOSTILE

VOID = {"meta", "img", "br", "input", "link", "hr"}


class Page(HTMLParser):
    """Collects what a browser would see, and that every tag is closed."""

    def __init__(self, text: str) -> None:
        super().__init__(convert_charrefs=True)
        self.tags: list[tuple[str, dict[str, str | None]]] = []
        self.words: list[str] = []
        self.code: dict[str, str] = {}
        self.open: list[str] = []
        self.feed(text)
        self.close()
        assert not self.open

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        if tag not in VOID:
            self.open.append(tag)

    def handle_endtag(self, tag):
        assert self.open.pop() == tag

    def handle_data(self, data):
        if self.open and self.open[-1] in ("script", "style"):
            self.code[self.open[-1]] = self.code.get(self.open[-1], "") + data
        else:
            self.words.append(data)

    def named(self, tag: str) -> list[dict[str, str | None]]:
        return [attributes for name, attributes in self.tags if name == tag]


@pytest.fixture
def source(page_path) -> str:
    return page_path.read_text(encoding="utf-8")


def test_nothing_is_fetched_and_nothing_hostile_runs(source):
    page = Page(source)
    tags = {name for name, _ in page.tags}
    assert not tags & {"link", "iframe", "object", "embed", "base", "form", "video", "audio"}
    assert len(page.named("script")) == len(page.named("style")) == 1
    for _, attributes in page.tags:
        assert not any(name.startswith("on") or name in ("href", "srcset") for name in attributes)
        assert "style" not in attributes  # the policy would refuse it
        if "src" in attributes:
            assert attributes["src"].startswith("data:image/png;base64,")
    code = page.code["script"] + page.code["style"]
    assert not re.search(r"url\(|@import|fetch|XMLHttp|https?:|innerHTML|eval|Function", code)


def test_policy_names_exactly_the_style_and_script_of_the_page(source):
    page = Page(source)
    policy = page.named("meta")[1]["content"]
    for tag, code in page.code.items():
        digest = base64.b64encode(hashlib.sha256(code.encode()).digest()).decode()
        assert f"{tag}-src 'sha256-{digest}'" in policy
    assert policy.startswith("default-src 'none'; img-src data:;")


def test_hostile_text_is_shown_as_it_is_wherever_it_comes_from(source):
    page = Page(source)
    text = "\n".join(page.words)
    for start in ("Title", "Summary", "before", "after", "Note", "chair", "target"):
        assert f"{start} {HOSTILE}" in text
    domains = [figure.get("data-domain") for figure in page.named("figure")]
    assert f"target {HOSTILE}" in domains
    assert any(f"after {HOSTILE}" in image["alt"] for image in page.named("img"))


def test_images_decode_and_are_described(source):
    images = Page(source).named("img")
    assert len(images) == 4  # curves, selection, two matrices
    for image in images:
        data = base64.b64decode(image["src"].split(",")[1], validate=True)
        pixels = imread(io.BytesIO(data), format="png")
        assert pixels.shape[1] >= 500
        assert pixels[..., :3].std() > 0.01
        assert image["alt"]


def test_scores_are_on_the_page_with_their_intervals(report, source):
    text = "".join(Page(source).words)
    assert "50.0 %" in text  # 15 of 30
    assert "96.7 %" in text
    assert "n = 30" in text
    low, high = (100 * x for x in next(iter(report.scores.values())).interval)
    assert f"95 % interval {low:.1f} to {high:.1f} %" in text


def bare(report, **parts):
    """The report without its parts but for those given."""
    empty = {"curves": (), "rounds": (), "notes": ()}
    empty |= {name: {} for name in ("scores", "clouds", "settings")}
    return dataclasses.replace(report, **empty | parts)


def test_table_of_rounds_holds_every_number(source):
    rows = re.findall(r"<tr>(.*?)</tr>", source)
    cells = [re.findall(r"<t[dh][^>]*>(.*?)</t[dh]>", row) for row in rows]
    assert cells[:3] == [
        ["round", "θ", "above θ", "selected", "agreement"],
        ["1", "0.810", "8", "4", "50 %"],
        ["2", "0.820", "1", "0 (skipped)", "–"],
    ]


def test_parts_that_are_empty_are_left_out(report):
    page = Page(render(bare(report)))
    for tag in ("section", "img", "canvas", "ul", "table"):
        assert not page.named(tag)
    assert not [a for a in page.named("div") if a.get("class") == "score"]
    clouds = {"source": report.clouds["source"][:1], "target": []}
    page = Page(render(bare(report, clouds=clouds)))
    assert len(page.named("option")) == 1  # a class without a cloud cannot be chosen


def test_same_report_gives_the_same_bytes(report, tmp_path):
    page = bare(report, scores=report.scores, clouds=report.clouds)
    for name in ("a", "b"):
        write_report(tmp_path / f"{name}.html", page)
    first, second = (path.read_bytes() for path in sorted(tmp_path.iterdir()))
    assert first == second
    assert str(tmp_path).encode() not in first


def test_viewer_has_every_cloud_of_every_domain(report, source):
    page = Page(source)
    assert "hidden" in next(a for a in page.named("div") if a.get("id") == "viewer")
    assert len(page.named("canvas")) == 2
    clouds = [cloud for domain in report.clouds.values() for cloud in domain]
    for item, cloud in zip(page.named("i"), clouds, strict=True):
        assert report.class_names[int(item["data-class"])] == cloud.class_name
        assert item["data-points"] == encode_points(cloud.points)
        assert item["data-note"] == cloud.note
    assert len(page.named("option")) == len(report.class_names)


def test_encoded_points_are_the_points_in_the_unit_ball(rng):
    points = 7.0 + rng.normal(size=(100, 3)) * [3, 1, 1]
    points[3] = np.nan
    whole = np.frombuffer(base64.b64decode(encode_points(points)), "<i2").reshape(-1, 3) / 32767
    assert np.linalg.norm(whole, axis=1).max() == pytest.approx(1.0, abs=1e-4)
    kept = np.delete(points, 3, axis=0)
    centre = (kept.min(axis=0) + kept.max(axis=0)) / 2
    scale = np.linalg.norm(kept - centre, axis=1).max()
    np.testing.assert_allclose(whole, (kept - centre) / scale, atol=2e-5)
    assert len(base64.b64decode(encode_points(rng.normal(size=(5000, 3))))) == 1024 * 6
    assert encode_points(np.zeros((0, 3))) == ""
