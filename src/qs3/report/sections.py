"""The parts of the page below its opening, in their order."""

import numpy as np

from qs3.report.clouds import gallery
from qs3.report.embedding import feature_map
from qs3.report.html import (
    flatten,
    folded,
    matrix_table,
    paragraph,
    picture,
    section,
    table,
)
from qs3.report.montage import montage
from qs3.report.plots import class_accuracy, confusion_heatmap, selection_counts, training_curves
from qs3.report.records import Report
from qs3.report.viewer import viewer

_COLUMNS = 4


def _sensor(report: Report) -> str:
    if report.montage is None:
        return ""
    return section(
        "From mesh to cloud",
        picture(
            montage(report.montage, report.montage_title),
            "Pattern, left and right image, disparity, depth, true depth and error of one view, "
            "and the cloud from the front, the side and the top",
            "One view through the simulated sensor, and the cloud of all views. Light grey pixels "
            "have no value.",
            wide=True,
        ),
    )


def _clouds(report: Report) -> str:
    shots = []
    for domain, clouds in report.clouds.items():
        classes = {
            name: [c.points for c in clouds if c.class_name == name] for name in report.class_names
        }
        if clouds:
            figure = gallery({name: own[:_COLUMNS] for name, own in classes.items()}, domain)
            shots.append(picture(figure, f"Sample clouds of each class, {domain}"))
    if not shots:
        return ""
    note = "The first clouds of each class, coloured by height. Labels of the target serve this "
    note += "page only."
    return section(
        "Sample clouds",
        f'<div class="pair">{"".join(shots)}</div>',
        paragraph(note, "soft"),
        viewer(report.clouds, report.class_names),
    )


def _features(report: Report) -> str:
    if not report.maps:
        return ""
    shots = [
        picture(
            feature_map(m.positions, m.labels, m.domains, report.class_names, m.name),
            f"Features of {m.name} in the plane, by t-SNE",
        )
        for m in report.maps
    ]
    return section(
        "Features of both domains",
        f'<div class="pair">{"".join(shots)}</div>',
        paragraph(
            "t-SNE of the features that a network decides on, a map a network; colours are true "
            "classes, markers domains. It keeps neighbours together: distances between clusters, "
            "their sizes and their density mean little, and two maps share no axes. Labels of the "
            "target serve this page only.",
            "soft",
        ),
    )


def _scores(report: Report) -> str:
    if not report.scores:
        return ""
    lines = report.scores
    paper, differ = any(s.published for s in lines), any(s.differs for s in lines)
    # Scores stand right after the name: on a phone they are seen without scrolling sideways.
    head = ["method", *["differs in"] * differ, "accuracy %", "class mean %"]
    head += ["published %"] * paper + ["marks", "chosen by", "network", "data"]
    words = ("method", "differs in", "marks", "chosen by", "network", "data")
    text = [index for index, name in enumerate(head) if name in words]
    rows, parts = [], []
    for s in lines:
        row = [s.name, *[s.differs] * differ, s.accuracy.format(), s.class_mean_accuracy.format()]
        row += [s.published or "–"] * paper + [", ".join(s.marks) or "–"]
        rows.append([*row, s.selection, s.network, s.data])
        title = " · ".join(filter(None, (s.name, s.network, s.differs)))
        clouds = f"{int(s.confusion.sum())} clouds, seeds {', '.join(map(str, s.seeds))}"
        parts.append(folded(f"{title}: {clouds}", matrix_table(s.confusion, s.class_names)))
    note = "Mean ± standard error (ddof = 1) over n seeds, from records alone."
    if paper:
        note += f" Published: {report.published_source}; those networks and data are the paper's, "
        note += "not the ones named here."
    return section(
        "All records",
        table(head, rows, text=text),
        paragraph(note, "soft"),
        _choices(report),
        folded("Confusion matrix of each line, summed over its seeds", "\n".join(parts)),
    )


def _choices(report: Report) -> str:
    lines = [s for s in report.scores if s.choices]
    rules = list(dict.fromkeys(rule for s in lines for rule in s.choices))
    if not rules:
        return ""
    rules.sort(key=lambda rule: rule == "oracle")  # apart, at the end
    rows = [
        [s.name, s.differs, *(s.choices[r].format() if r in s.choices else "–" for r in rules)]
        for s in lines
    ]
    head = ["method", "differs in", *(f"{r} *" if r == "oracle" else r for r in rules)]
    note = "Accuracy in % at the checkpoint that each rule would have chosen."
    if "oracle" in rules:
        note += " * looks at labels of the test set: an upper bound, no result."
    body = table(head, rows, text=(0, 1)) + paragraph(note, "soft")
    return folded("What each rule would have chosen", body)


def _data(report: Report) -> str:
    if not report.data:
        return ""
    rows = [[d.role, d.name, d.clouds, d.checksum] for d in report.data]
    return section(
        "Data",
        table(["role", "name", "clouds", "SHA-256"], rows, text=(0, 1)),
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
    names, outcomes = report.class_names, report.outcomes
    if not outcomes:
        return ""
    shots = [
        picture(confusion_heatmap(o.confusion, names, o.name), f"Confusion matrix of {o.name}")
        for o in outcomes
    ]
    bars = ""
    if len(outcomes) == 2:
        before, after = outcomes
        counts = before.confusion.sum(axis=1).astype(np.int64)
        bars = picture(
            class_accuracy(
                before.class_accuracy,
                after.class_accuracy,
                names,
                counts,
                (before.name, after.name),
            ),
            "Accuracy of each class before and after adaptation",
            "In brackets: test clouds of the class. Few clouds make a wide interval.",
        )
    return section(
        "Before and after" if len(outcomes) == 2 else "What it takes for what",
        f'<div class="pair">{"".join(shots)}</div>',
        paragraph("Numbers are clouds; the shade is the share of the true class.", "soft"),
        bars,
    )


def _settings(report: Report) -> str:
    blocks = [
        folded(name, table(["name", "value"], flatten(values), text=(0, 1)))
        for name, values in (("Settings", report.settings), ("Versions", report.versions))
        if values
    ]
    return section("Settings and versions", *blocks)


def sections(report: Report) -> list[str]:
    """Return the parts of a page that have content, in their order.

    The table of records comes first where there are more than the runs told in full.
    """
    order = [_sensor, _clouds, _training, _features, _selection, _results, _data, _settings]
    order.insert(0 if len(report.scores) > 2 else -2, _scores)
    return [part for part in (make(report) for make in order) if part]
