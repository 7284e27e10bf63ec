"""A filled table as Markdown, CSV or LaTeX."""

from collections.abc import Callable, Mapping, Sequence

import pandas as pd

from qs3.evaluation.records import RunRecord, count_rounds
from qs3.evaluation.tables import SCORES, to_csv, to_latex, to_markdown
from qs3.experiments import TableFormat
from qs3.experiments.domains import DataSet, data_of
from qs3.experiments.experiment import Heading, Place
from qs3.experiments.runs import SUPERVISED
from qs3.experiments.setup import MARKER, read_marker
from qs3.experiments.table import FilledTable


def markdown(filled: FilledTable) -> str:
    """Return the table as Markdown, with what a reader must know."""
    table, experiment = filled.table, filled.table.experiment
    smoke = "*smoke* — " if table.setup.scale.smoke else ""
    text = [f"# {smoke}{experiment.title}", ""]
    for paragraph in (*_intro(filled), *experiment.notes):
        text += [paragraph, ""]
    text += ["Accuracy:", "", to_markdown(_scores(filled, "accuracy", True)), ""]
    text += ["Class-mean accuracy:", "", to_markdown(_scores(filled, "class_mean_accuracy")), ""]
    if any(all(record.cpu_seconds for record in filled.records_of(at)) for at in filled.means):
        text += [
            "CPU minutes of a run and its warm-up · CPU seconds for each point of its accuracy · "
            "steps of both · accuracy on its own source:"
        ]
        text += ["", to_markdown(_scores(filled, "cost")), ""]
    for column in table.headings()[1]:
        text += _further(filled, column)
    if filled.waiting:
        text += [
            f"{len(filled.waiting)} cells wait for runs (… or few seeds); this command makes them, "
            "and only what is missing:",
            "",
            f"    {_command(filled)}",
            "",
        ]
    if caveats := _caveats(filled):
        text += ["Caveats:", "", *(f"- {line}" for line in caveats), ""]
    if differences := filled.differences():
        text += ["Differences, seed by seed:", ""]
        text += [f"- {what}: {value.format()}" for what, value in differences]
        text += [""]
    return "\n".join([*text, f"Paper: {experiment.paper}", ""])


def csv(filled: FilledTable) -> str:
    """Return one line a run."""
    lines = filled.frame()
    columns = ["row", "column", "seed", *SCORES, "paper_mean", "paper_sem"]
    if lines.empty:
        return to_csv(pd.DataFrame(columns=[*columns, "marks"]))
    places = list(zip(lines["row"], lines["column"], strict=True))
    cells = [filled.table.experiment.published_cell(*place) for place in places]
    for index, name in enumerate(("paper_mean", "paper_sem")):
        lines[name] = [cell and cell[index] for cell in cells]
    lines["marks"] = [", ".join(filled.marks(place)) for place in places]
    return to_csv(lines.filter([*columns, "marks"]))


def latex(filled: FilledTable) -> str:
    """Return the accuracies as a LaTeX tabular, with the paper's figures in brackets."""
    experiment, scale = filled.table.experiment, filled.table.setup.scale
    rows, columns = filled.table.headings()
    body = [
        [row.title, *(_with_published(filled, (row.key, column.key)) for column in columns)]
        for row in rows
    ]
    head = [experiment.corner, *(column.title for column in columns)]
    smoke = "smoke: " if scale.smoke else ""
    comments = [
        f"% {smoke}{experiment.title}; accuracy in per cent, mean ± standard error over",
        f"% n seeds; in brackets: {experiment.paper}",
        *(f"% {line}" for line in _caveats(filled)),
    ]
    return "\n".join([*comments, to_latex(pd.DataFrame(body, columns=head)), ""])


FORMATS: Mapping[TableFormat, Callable[[FilledTable], str]] = {
    "md": markdown,
    "csv": csv,
    "tex": latex,
}
"""Each form of a table."""


def _scores(filled: FilledTable, score: str, with_published: bool = False) -> pd.DataFrame:
    """Means of a score as text; beside a column that has published figures these."""
    rows, columns = filled.table.headings()
    body: list[list[str]] = [[row.title] for row in rows]
    head = [filled.table.experiment.corner]
    for column in columns:
        places = [(row.key, column.key) for row in rows]
        head.append(f"{column.title}, %")
        for line, place in zip(body, places, strict=True):
            line.append(_value(filled, place, score))
        cells = [_published(filled, place) for place in places]
        if with_published and any(cells):
            head.append("paper")
            for line, text in zip(body, cells, strict=True):
                line.append(text or "–")
    return pd.DataFrame(body, columns=head)


def _value(filled: FilledTable, place: Place, score: str) -> str:
    if place not in filled.means:
        return "…" if filled.runs[place] else "–"
    if score == "cost":
        return _cost(filled.records_of(place))
    mean = filled.means[place]
    trained, rounds, text = mean["trained"], mean["rounds"], mean[score].format()
    if trained == rounds:
        return text
    return f"{text} ({f'{trained} of {rounds} rounds' if trained else 'no round'} trained)"


def _cost(records: Sequence[RunRecord]) -> str:
    """What a cell cost, mean over its seeds, and how well it fits its source."""
    if not all(record.cpu_seconds for record in records):
        return "–"
    seconds, steps = (
        sum(cost.get("total", 0) + cost.get("warm-up", 0) for cost in costs) / len(records)
        for costs in zip(*((r.cpu_seconds, r.steps) for r in records), strict=True)
    )
    fits = [r.source_accuracy for r in records if r.source_accuracy is not None]
    own = f"{100 * sum(fits) / len(fits):.1f} %" if fits else "–"
    points = 100 * sum(record.scores.accuracy for record in records) / len(records)
    each = f"{seconds / points:.1f}" if points else "–"
    return f"{seconds / 60:.1f} · {each} · {steps:,.0f} · {own}"


def _published(filled: FilledTable, place: Place) -> str:
    mean, sem = filled.table.experiment.published_cell(*place) or (None, None)
    return "" if mean is None else f"{mean}" if sem is None else f"{mean} ± {sem}"


def _with_published(filled: FilledTable, place: Place) -> str:
    text = _published(filled, place)
    return _value(filled, place, "accuracy") + (f" [{text}]" if text else "")


def _caveats(filled: FilledTable) -> list[str]:
    """Return which cells have which caveats."""
    rows, columns = ({h.key: h.title for h in part} for part in filled.table.headings())
    cells: dict[str, list[str]] = {}
    for row, column in filled.runs:
        for mark in filled.marks((row, column)):
            cells.setdefault(mark, []).append(f"{rows[row]} on {columns[column]}")
    return [f"{mark}: {'; '.join(places)}" for mark, places in cells.items()]


def _further(filled: FilledTable, column: Heading) -> list[str]:
    """Return what the rounds of a column kept."""
    rows = filled.table.headings()[0]
    cells = {row.title: filled.records_of((row.key, column.key)) for row in rows}
    kept = _kept({title: records for title, records in cells.items() if records})
    if kept.empty:
        return []
    head = f"{column.title}, clouds kept in the last round / right of them, by pseudo label:"
    return [head, "", to_markdown(kept), ""]


def _kept(cells: Mapping[str, Sequence[RunRecord]]) -> pd.DataFrame:
    """Clouds kept of the last round, mean over seeds, of each line that has rounds.

    A round that keeps fewer than two clouds a class leaves the network as it is: a line without a
    round that trained is the network before the rounds.
    """
    lines: list[dict[str, str]] = []
    for title, records in cells.items():
        last = [record.rounds[-1] for record in records if record.rounds]
        if last:
            counts = pd.DataFrame([done["kept"] for done in last]).mean()
            right = [""] * len(counts)
            if all("right" in done for done in last):
                means = pd.DataFrame([done["right"] for done in last]).mean()
                right = [f" / {mean:.1f}" for mean in means]
            confident = sum(sum(done["confident"]) for done in last) / len(last)
            trained, rounds = count_rounds(records)
            names = records[0].scores.class_names
            lines.append(
                {"method": title}
                | {n: f"{c:.1f}{r}" for n, c, r in zip(names, counts, right, strict=True)}
                | {"kept of confident": f"{counts.sum():.1f} of {confident:.1f}"}
                | {"rounds that trained": f"{trained} of {rounds}"}
            )
    return pd.DataFrame(lines)


def _command(filled: FilledTable) -> str:
    """Return the command that makes what is missing."""
    setup = filled.table.setup
    words = [f"qs3 reproduce {filled.table.name} --out {setup.out.name} --scale {setup.scale.name}"]
    chosen = {"methods": filled.table.rows, "tasks": filled.table.columns, "seeds": setup.seeds}
    words += [f"--{name} {' '.join(map(str, keys))}" for name, keys in chosen.items() if keys]
    words += [f"--threads {setup.threads}"] if setup.threads not in (None, 1) else []
    for kind, own in setup.own.items():
        test = own.test.split if own.test else None
        words.append(f"--data {kind}={own.train.data.name}:{own.train.split or ''}:{test or ''}")
    return " ".join(words)


def _intro(filled: FilledTable) -> list[str]:
    """Paragraphs about data, stand-ins and training."""
    setup = filled.table.setup
    scale, own = setup.scale, setup.own
    runs = [run for runs in filled.runs.values() for run in runs]
    train = runs[0].train  # the same for all but for network and seed
    sources = [run.source for run in runs if run.row != SUPERVISED]
    data = [data_of(domain, own) for domain in dict.fromkeys([*sources, *(r.target for r in runs)])]
    steps = scale.optimiser_steps
    epochs = f"{train.epochs} epochs" if steps is None else f"about {steps:,} steps"
    made = any(domain.train.data == DataSet("source") for domain in data)
    objects = f", {scale.source_per_class} objects a class of M and S" if made else ""
    text = [
        f"Scale {scale.name}{objects}: {train.num_points} points, "
        f"{epochs}, batches of {train.batch_size}, schedule {train.schedule}, network "
        f"{train.model} unless a line says otherwise; "
        f"seeds {', '.join(map(str, setup.seeds))}. Per cent, mean ± standard error "
        "(ddof = 1) over n seeds, from the records alone; the network is the last epoch's.",
        " ".join(["; ".join(domain.title for domain in data) + ".", *_scored(filled)]),
    ]
    stand_ins = [
        f"{domain.title.partition(':')[0]} for {domain.stands_for}"
        for domain in data
        if domain.stands_for
    ]
    if stand_ins:
        text.append(
            f"**Stand-ins, made here**: {', '.join(stand_ins)}. A simulator on both sides "
            "flatters, and the paper's figures are of its own data: a yardstick, no target."
        )
    if scale.rounds and any(run.self_training is not None for run in runs):
        text.append(scale.describe_rounds())
    if scale.smoke:
        text.append(
            "Below 40 training objects a class, 256 points or the whole networks: shows that "
            "everything runs, ranks nothing."
        )
    return text


def _scored(filled: FilledTable) -> list[str]:
    """Say which meshes take part, and how many clouds are scored."""
    setup = filled.table.setup
    text = []
    if (setup.out / MARKER).is_file():
        shapes_alone = read_marker(setup.out).meshes == "shapes"
        meshes = "procedural shapes alone" if shapes_alone else "procedural and artists' meshes"
        text.append(f"Meshes: {meshes}.")
    runs = [run for cell in filled.runs.values() for run in cell if run.name in filled.records]
    clouds = {str(run.target): filled.records[run.name].test.clouds for run in runs}
    if clouds:
        counts = [f"{count} clouds of {target}" for target, count in clouds.items()]
        text.append(f"Scored on {', '.join(counts)}.")
    return text
