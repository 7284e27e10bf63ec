"""The report of a run as one HTML file that needs no network, no script and no other file."""

import base64
import hashlib
from importlib import resources
from pathlib import Path

import numpy as np

from qs3.files import write_text
from qs3.report.html import escape, flatten, folded, paragraph, picture, section, table
from qs3.report.records import Outcome, Report
from qs3.report.verdict import Verdict, judge
from qs3.report.viewer import viewer
from qs3.visualisation import (
    class_accuracy,
    confusion_heatmap,
    gallery,
    montage,
    selection_counts,
    training_curves,
)

_KIND = {"helped": "helped", "hurt": "hurt", "no clear difference": "unclear"}


def write_report(path: Path, report: Report) -> Verdict:
    """Write the page to ``path``, whole or not at all, and return its verdict.

    The same report gives the same bytes: the page holds no time, no host and no path of its own.
    """
    verdict = judge(report.before, report.after)
    write_text(Path(path), render(report, verdict))
    return verdict


def render(report: Report, verdict: Verdict) -> str:
    """Return the page as text."""
    style, script = _asset("page.css"), _asset("viewer.js")
    # Only this style and this script may act, and nothing may be fetched.
    policy = (
        f"default-src 'none'; img-src data:; style-src '{_digest(style)}'; "
        f"script-src '{_digest(script)}'; base-uri 'none'; form-action 'none'"
    )
    parts = [
        _opening(report, verdict),
        _sensor(report),
        _samples(report),
        _training(report),
        _selection(report),
        _results(report),
        _settings(report),
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


def _opening(report: Report, verdict: Verdict) -> str:
    opening, _, rest = verdict.text.partition(": ")
    notes = "".join(f"<li>{escape(note)}</li>" for note in report.notes)
    return "\n".join(
        [
            f"<header><h1>{escape(report.title)}</h1>",
            paragraph(report.summary),
            "</header>",
            f'<div class="verdict {_KIND[verdict.finding]}" id="verdict">'
            f"<p><strong>{escape(opening)}.</strong> {escape(rest[:1].upper() + rest[1:])}</p>"
            "</div>",
            f'<div class="scores">{_score(report.before)}{_score(report.after)}</div>',
            f"<ul>{notes}</ul>" if notes else "",
        ]
    )


def _score(outcome: Outcome) -> str:
    low, high = (100.0 * x for x in outcome.interval)
    return (
        f'<div class="score">{escape(outcome.name)}<b>{100.0 * outcome.accuracy:.1f} %</b>'
        f'<span class="soft">95 % interval {low:.1f} to {high:.1f} %, n = {outcome.total}<br>'
        f"class mean {100.0 * outcome.class_mean_accuracy:.1f} %</span></div>"
    )


def _sensor(report: Report) -> str:
    if report.montage is None:
        return ""
    return section(
        "From mesh to cloud",
        picture(
            montage(report.montage),
            "Pattern, left and right image, disparity, depth, true depth and error of one view, "
            "and the cloud from the front, the side and the top",
            "One view through the simulated sensor, and the cloud of all views. Light grey pixels "
            "have no value.",
            wide=True,
        ),
    )


def _samples(report: Report) -> str:
    shots = [
        picture(gallery(classes, domain), f"Sample clouds of each class, {domain}")
        for domain, classes in report.samples.items()
        if classes
    ]
    if not shots:
        return ""
    note = "The first clouds of each class, coloured by height. Labels of the target serve this "
    note += "page only."
    return section(
        "Sample clouds",
        f'<div class="pair">{"".join(shots)}</div>',
        paragraph(note, "soft"),
        viewer(report.samples),
    )


def _training(report: Report) -> str:
    if not report.curves:
        return ""
    panels = " and ".join(dict.fromkeys(curve.panel for curve in report.curves))
    return section(
        "Training",
        picture(training_curves(report.curves, report.marks), f"Curves of {panels} over epochs"),
    )


def _selection(report: Report) -> str:
    if not report.rounds:
        return ""
    told = any(r.agreement is not None for r in report.rounds)
    noted = any(r.note for r in report.rounds)
    head = ["round", "θ", "above θ", "selected"]
    head += ["agreement"] * told + ["note"] * noted + list(report.class_names)
    rows = []
    for r in report.rounds:
        pairs = zip(r.kept, r.confident, strict=True)
        share = "–" if r.agreement is None else f"{100.0 * r.agreement:.1f} %"
        cells = [r.index, f"{r.theta:.3f}", int(r.confident.sum()), int(r.kept.sum())]
        cells += [share] * told + [r.note] * noted
        rows.append(cells + [f"{int(kept)} / {int(above)}" for kept, above in pairs])
    return section(
        "What self-training selected",
        picture(
            selection_counts(report.rounds, report.class_names),
            "Selected clouds of each round by predicted class, and the threshold",
        ),
        paragraph("By class: selected / above θ.", "soft"),
        table(head, rows, text=[4 + told] if noted else []),
        paragraph(report.agreement_meaning, "soft") if told and report.agreement_meaning else "",
    )


def _results(report: Report) -> str:
    before, after, names = report.before, report.after, report.class_names
    counts = before.confusion.sum(axis=1).astype(np.int64)
    shots = [
        picture(confusion_heatmap(o.confusion, names, o.name), f"Confusion matrix of {o.name}")
        for o in (before, after)
    ]
    bars = class_accuracy(
        before.class_accuracy, after.class_accuracy, names, counts, (before.name, after.name)
    )
    return section(
        "Before and after",
        f'<div class="pair">{"".join(shots)}</div>',
        paragraph("Numbers are clouds; the shade is the share of the true class.", "soft"),
        picture(
            bars,
            "Accuracy of each class before and after adaptation",
            "In brackets: test clouds of the class. Few clouds make a wide interval.",
        ),
    )


def _settings(report: Report) -> str:
    blocks = [
        folded(name, table(["name", "value"], flatten(values), text=(0, 1)))
        for name, values in (("Settings", report.settings), ("Versions", report.versions))
        if values
    ]
    return section("Settings and versions", *blocks)


def _asset(name: str) -> str:
    return resources.files("qs3.report").joinpath(name).read_text(encoding="utf-8")


def _digest(text: str) -> str:
    digest = hashlib.sha256(text.encode("utf-8")).digest()
    return f"sha256-{base64.b64encode(digest).decode('ascii')}"
