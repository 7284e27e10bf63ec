"""``qs3 report`` as a user calls it."""

import re


def test_the_page_of_a_run_has_every_part(typed, store, run, tmp_path, quick):
    typed("evaluate", run, "--data", store)
    out = tmp_path / "page.html"
    done = typed("report", run, "--data", store, "--source", store, "--out", out)
    assert done.stdout == f"{out}\n"
    assert [path.name for path in tmp_path.iterdir()] == ["page.html"]
    page = out.read_text("utf-8")
    assert re.findall(r"<h2>(.*?)</h2>", page) == [
        "Clouds",
        "Training",
        "Confusion matrix",
        "Settings, data and versions",
    ]
    assert re.findall(r'<div class="score">([\w-]+)<b>', page) == ["source-only"]
    assert len(re.findall(r'<i data-class="\d+"', page)) == 20
    assert str(run.parent) not in page


def test_refusals_are_one_line_and_leave_no_page(typed, run, tmp_path):
    assert "none" in typed.refuses("report", tmp_path / "none")
    assert "--out" in typed.refuses("report", run, "--out", tmp_path)
    assert "--split goes with --data" in typed.refuses("report", run, "--split", "test")
    assert "--clouds -1" in typed.refuses("report", run, "--clouds", -1)
    assert not list(tmp_path.rglob("*.html"))
    assert not (run / "report.html").exists()
