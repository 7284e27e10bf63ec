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
from qs3.report.verdict import judge

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
    text = "\n".join(Page(source).words)
    for start in ("Title", "Summary", "before", "after", "qs3 demo", "0.1.0"):
        assert f"{start} {HOSTILE}" in text
    for start in ("Note", "chair", "data", "line", "theta", "mark", "paper"):
        assert f"{start} {HOSTILE}" in text
    for heading in ("target", "scan", "mesh"):
        assert f"{heading} {HOSTILE}" in text
    assert any(f["data-domain"] == f"target {HOSTILE}" for f in Page(source).named("figure")
               if "data-domain" in f)  # fmt: skip
    alternatives = [i["alt"] for i in Page(source).named("img")]
    assert any(f"map {HOSTILE}" in text for text in alternatives)


def test_images_decode_and_are_described(source):
    images = Page(source).named("img")
    # two of the scan, two galleries, curves, map, selection, two matrices, bars
    assert len(images) == 10
    for image in images:
        data = base64.b64decode(image["src"].split(",")[1], validate=True)
        pixels = imread(io.BytesIO(data), format="png")
        assert pixels.shape[1] >= 500
        assert pixels[..., :3].std() > 0.01
        assert image["alt"]


def test_phone_dark_mode_and_language(source):
    page = Page(source)
    assert page.named("html") == [{"lang": "en"}]
    view = [m for m in page.named("meta") if m.get("name") == "viewport"]
    assert view[0]["content"] == "width=device-width, initial-scale=1"
    assert "prefers-color-scheme: dark" in page.code["style"]


def test_verdict_and_scores_are_on_the_page(report, source):
    text = "".join(Page(source).words)
    assert "Adaptation helped." in text
    assert "53.3 %" in text  # 16 of 30
    assert "96.7 %" in text
    assert "n = 30" in text
    low, high = (100 * x for x in report.before.scores.interval)
    assert f"95 % interval {low:.1f} to {high:.1f} %" in text


def bare(report, **parts):
    """The report without its pictures but for what is given."""
    empty = dict.fromkeys(("before", "after", "montage")) | dict.fromkeys(
        ("maps", "scores", "curves", "rounds", "notes"), ()
    )
    none = ("clouds", "mistakes", "nearest", "data", "settings", "versions")
    none = {part: {} for part in none}
    return dataclasses.replace(report, **empty | none | parts)


@pytest.mark.parametrize("kind", ["hurt", "unclear"])
def test_bad_news_is_told_as_it_is(report, kind):
    before = report.before if kind == "unclear" else report.after
    page = Page(render(bare(report, before=before, after=report.before)))
    assert [a["class"] for a in page.named("div") if a.get("id") == "verdict"] == [
        f"verdict {kind}"
    ]
    words = {"hurt": "Adaptation hurt.", "unclear": "No clear difference."}
    assert words[kind] in "".join(page.words)


def cells_of(source):
    """The texts of each row of each table."""
    rows = re.findall(r"<tr>(.*?)</tr>", source)
    return [re.findall(r"<t[dh][^>]*>(.*?)</t[dh]>", row) for row in rows]


def test_table_of_rounds_holds_every_number(source):
    cells = cells_of(source)
    assert cells[:5] == [
        ["round", "1", "2"],
        ["θ", "0.800", "0.805"],
        ["above θ", "8", "1"],
        ["selected", "4", "0"],
        ["agreement", "50 %", "–"],
    ]
    assert [row[1:] for row in cells[5:8]] == [
        ["2 / 5", "0 / 1"],
        ["0 / 0"] * 2,
        ["2 / 3", "0 / 0"],
    ]
    assert any(word.startswith("Round 2: ") for word in Page(source).words)


def test_settings_are_folded_away_and_complete(source):
    opened = [a for a in Page(source).named("details") if "open" in a]
    assert len(Page(source).named("details")) == 5  # two of them of the records
    assert not opened
    assert '<td class="text">sensor.views</td><td class="text">5</td>' in source


def test_parts_that_are_empty_are_left_out(report):
    page = Page(render(bare(report)))
    assert len(page.named("section")) == 1
    assert not page.named("img") + page.named("canvas") + page.named("ul")
    assert not [a for a in page.named("div") if a.get("class") == "score"]


def test_same_report_gives_the_same_bytes_and_its_verdict(report, tmp_path):
    page = bare(report, before=report.before, after=report.after, scores=report.scores)
    for name in ("a", "b"):
        verdict = write_report(tmp_path / f"{name}.html", page)
    assert verdict == judge(report.before, report.after)
    first, second = (path.read_bytes() for path in sorted(tmp_path.iterdir()))
    assert first == second
    assert str(tmp_path).encode() not in first


def test_one_network_makes_a_page_without_a_verdict(report, tmp_path):
    assert write_report(tmp_path / "a.html", bare(report, after=report.after)) is None
    page = Page((tmp_path / "a.html").read_text())
    assert not [a for a in page.named("div") if a.get("id") == "verdict"]
    assert len([a for a in page.named("div") if a.get("class") == "score"]) == 1


def test_table_of_records_has_published_values_marks_and_the_oracle_apart(source):
    cells = cells_of(source)
    line = next(row for row in cells if row[0].startswith("line ") and len(row) == 9)
    assert line[2:5] == ["55.0 ± 5.0 (n=2)", "50.0 ± 10.0 (n=2)", "72.4 ± 0.8"]
    assert line[5].startswith("transductive, mark ")
    assert line[6:8] == ["last", "dgcnn"]
    oracle = next(row for row in cells if row[-1] == "oracle *")
    assert oracle[2:] == ["last", "oracle *"]
    assert "an upper bound, no result" in source


def test_matrix_of_a_line_holds_its_counts_shaded_by_share(source):
    table = re.search(r'<table class="matrix">(.*?)</table>', source, re.DOTALL)
    cells = [
        re.findall(r"<td(?: class=\"(\w+)\")?>(\d*)</td>", row)
        for row in re.findall(r"<tr>(.*?)</tr>", table[1])[1:]
    ]
    assert cells[0] == [("s3", "6"), ("s2", "4"), ("", ""), ("", "")]
    assert cells[2] == [("", ""), ("s2", "5"), ("s2", "5"), ("", "")]


def test_viewer_has_every_cloud_of_every_domain(report, source):
    page = Page(source)
    assert "hidden" in next(a for a in page.named("div") if a.get("id") == "viewer")
    columns = [
        own for part in (report.clouds, report.mistakes, report.nearest) for own in part.values()
    ]
    assert len(page.named("canvas")) == len(columns) == 5
    clouds = [cloud for own in columns for cloud in own]
    for item, cloud in zip(page.named("i"), clouds, strict=True):
        assert report.class_names[int(item["data-class"])] == cloud.class_name
        assert item["data-points"] == encode_points(cloud.points)
        assert item["data-note"] == cloud.note
        spans = cloud.points.max(axis=0) - cloud.points.min(axis=0)
        assert spans.max() / 2 <= float(item["data-radius"]) * 1.001
        assert float(item["data-radius"]) <= np.linalg.norm(spans) / 2 * 1.001
    assert len(page.named("option")) == 3 * (1 + len(report.class_names))


def test_class_without_a_cloud_cannot_be_chosen(report):
    clouds = {"source": report.clouds["source"][:1], "target": []}
    page = Page(render(bare(report, clouds=clouds)))
    assert len(page.named("option")) == 2
    assert len(page.named("canvas")) == 2
    assert not Page(render(bare(report, clouds={"source": []}))).named("canvas")


def test_two_hundred_clouds_stay_far_below_fifteen_megabytes(page_path, rng):
    items = 200 * (len(encode_points(rng.normal(size=(1024, 3)))) + 200)
    assert page_path.stat().st_size + items < 15e6


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
