"""The report of a run as one HTML file that needs no network, no script and no other file."""

import base64
import hashlib
from importlib import resources
from pathlib import Path

from qs3.files import write_text
from qs3.report.html import escape, paragraph, section
from qs3.report.records import Outcome, Report
from qs3.report.sections import sections
from qs3.report.verdict import Verdict, judge

_KIND = {"helped": "helped", "hurt": "hurt", "no clear difference": "unclear"}


def write_report(path: Path, report: Report) -> Verdict | None:
    """Write the page to ``path``, whole or not at all, and return its verdict.

    The same report gives the same bytes: the page holds no time, no host and no path of its own.

    Returns:
        What the numbers say of adaptation; None where there are not two models to compare.
    """
    verdict = None
    if report.before is not None and report.after is not None:
        verdict = judge(report.before, report.after)
    write_text(Path(path), render(report, verdict))
    return verdict


def render(report: Report, verdict: Verdict | None = None) -> str:
    """Return the page as text."""
    style, script = _asset("page.css"), _asset("viewer.js")
    # Only this style and this script may act, and nothing may be fetched.
    policy = (
        f"default-src 'none'; img-src data:; style-src '{_digest(style)}'; "
        f"script-src '{_digest(script)}'; base-uri 'none'; form-action 'none'"
    )
    parts = [
        _opening(report, verdict),
        *sections(report),
        section("How to make it again", f"<pre><code>{escape(report.command)}</code></pre>"),
    ]
    body = "\n".join(part for part in parts if part)
    return (
        '<!DOCTYPE html>\n<html lang="en">\n<head>\n<meta charset="utf-8">\n'
        f'<meta http-equiv="Content-Security-Policy" content="{policy}">\n'
        '<meta name="viewport" content="width=device-width, initial-scale=1">\n'
        f"<title>{escape(report.title)}</title>\n<style>{style}</style>\n</head>\n"
        f"<body>\n<main>\n{body}\n</main>\n<script>{script}</script>\n</body>\n</html>\n"
    )


def _opening(report: Report, verdict: Verdict | None) -> str:
    notes = "".join(f"<li>{escape(note)}</li>" for note in report.notes)
    scores = "".join(map(_score, report.outcomes))
    return "\n".join(
        [
            f"<header><h1>{escape(report.title)}</h1>",
            paragraph(report.summary),
            "</header>",
            "" if verdict is None else _verdict(verdict),
            f'<div class="scores">{scores}</div>' if scores else "",
            f"<ul>{notes}</ul>" if notes else "",
        ]
    )


def _verdict(verdict: Verdict) -> str:
    opening, _, rest = verdict.text.partition(": ")
    return (
        f'<div class="verdict {_KIND[verdict.finding]}" id="verdict">'
        f"<p><strong>{escape(opening)}.</strong> {escape(rest[:1].upper() + rest[1:])}</p></div>"
    )


def _score(outcome: Outcome) -> str:
    low, high = (100.0 * x for x in outcome.interval)
    return (
        f'<div class="score">{escape(outcome.name)}<b>{100.0 * outcome.accuracy:.1f} %</b>'
        f'<span class="soft">95 % interval {low:.1f} to {high:.1f} %, n = {outcome.total}<br>'
        f"class mean {100.0 * outcome.class_mean_accuracy:.1f} %</span></div>"
    )


def _asset(name: str) -> str:
    return resources.files("qs3.report").joinpath(name).read_text(encoding="utf-8")


def _digest(text: str) -> str:
    digest = hashlib.sha256(text.encode("utf-8")).digest()
    return f"sha256-{base64.b64encode(digest).decode('ascii')}"
