"""A table as Markdown, CSV or LaTeX."""

from collections.abc import Callable, Mapping, Sequence

import pandas as pd

from qs3.evaluation.records import RunRecord, count_rounds
from qs3.evaluation.tables import SCORES, to_csv, to_latex, to_markdown
from qs3.experiments import TableFormat
from qs3.experiments.domains import DataSet, data_of
from qs3.experiments.experiment import Heading, Place
from qs3.experiments.runs import SUPERVISED
from qs3.experiments.setup import MARKER, read_marker
from qs3.experiments.table import Table
from qs3.training.run import FOREST_MODEL


def markdown(table: Table) -> str:
    """Return the table as Markdown, with its data, caveats and comparisons."""
    experiment = table.experiment
    smoke = "*smoke* — " if table.setup.scale.smoke else ""
    text = [f"# {smoke}{experiment.title}", ""]
    for paragraph in (*_intro(table), *experiment.notes):
        text += [paragraph, ""]
    text += ["Accuracy:", "", to_markdown(_scores(table, "accuracy", True)), ""]
    text += ["Class-mean accuracy:", "", to_markdown(_scores(table, "class_mean_accuracy")), ""]
    if any(all(record.cpu_seconds for record in table.records_of(at)) for at in table.means):
        text += [
            "CPU minutes of a run and its warm-up · CPU seconds for each point of its accuracy · "
            "steps of both · accuracy on its own source:",
            "",
            to_markdown(_scores(table, "cost")),
            "",
        ]
    for column in table.headings[1]:
        kept = _kept(table, column)
        if not kept.empty:
            head = f"{column.title}, clouds kept in the last round / right of them"
            text += [f"{head}, by pseudo label:", "", to_markdown(kept), ""]
    if table.waiting:
        text += [
            f"{len(table.waiting)} cells wait for runs (… or few seeds); this command makes them, "
            "and only what is missing:",
            "",
            f"    {_command(table)}",
            "",
        ]
    if caveats := _caveats(table):
        text += ["Caveats:", "", *(f"- {line}" for line in caveats), ""]
    if differences := table.differences():
        lines = [f"- {what}: {value.format()}" for what, value in differences]
        text += ["Differences, seed by seed:", "", *lines, ""]
    return "\n".join([*text, f"Paper: {experiment.paper}", ""])


def csv(table: Table) -> str:
    """Return one line a run."""
    lines = table.frame()
    columns = ["row", "column", "seed", *SCORES, "paper_mean", "paper_sem", "marks"]
    if lines.empty:
        return to_csv(pd.DataFrame(columns=columns))
    places = list(zip(lines["row"], lines["column"], strict=True))
    cells = [table.experiment.published_cell(*place) for place in places]
    for index, name in enumerate(("paper_mean", "paper_sem")):
        lines[name] = [cell and cell[index] for cell in cells]
    lines["marks"] = [", ".join(table.marks(place)) for place in places]
    return to_csv(lines.filter(columns))


def latex(table: Table) -> str:
    """Return the accuracies as a LaTeX tabular, with the paper's figures in brackets."""
    experiment = table.experiment
    rows, columns = table.headings
    body = [
        [row.title, *(_with_published(table, (row.key, column.key)) for column in columns)]
        for row in rows
    ]
    head = [experiment.corner, *(column.title for column in columns)]
    smoke = "smoke: " if table.setup.scale.smoke else ""
    comments = [
        f"% {smoke}{experiment.title}; accuracy in per cent, mean ± standard error over",
        f"% n seeds; in brackets: {experiment.paper}",
        *(f"% {line}" for line in _caveats(table)),
    ]
    return "\n".join([*comments, to_latex(pd.DataFrame(body, columns=head)), ""])


FORMATS: Mapping[TableFormat, Callable[[Table], str]] = {
    "md": markdown,
    "csv": csv,
    "tex": latex,
}


def _scores(table: Table, score: str, with_published: bool = False) -> pd.DataFrame:
    rows, columns = table.headings
    parts = [(table.experiment.corner, [row.title for row in rows])]
    for column in columns:
        places = [(row.key, column.key) for row in rows]
        parts.append((f"{column.title}, %", [_value(table, place, score) for place in places]))
        printed = [_published(table, place) for place in places]
        if with_published and any(printed):
            parts.append(("paper", [text or "–" for text in printed]))
    body = list(zip(*(cells for _, cells in parts), strict=True))
    return pd.DataFrame(body, columns=[head for head, _ in parts])


def _value(table: Table, place: Place, score: str) -> str:
    if place not in table.means:
        return "…" if table.cells[place] else "–"
    if score == "cost":
        return _cost(table.records_of(place))
    mean = table.means[place]
    trained, rounds, text = mean["trained"], mean["rounds"], mean[score].format()
    if trained == rounds:
        return text
    return f"{text} ({f'{trained} of {rounds} rounds' if trained else 'no round'} trained)"


def _cost(records: Sequence[RunRecord]) -> str:
    """Return the cost of a cell, mean over its seeds, and the accuracy on its source."""
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


def _published(table: Table, place: Place) -> str:
    mean, sem = table.experiment.published_cell(*place) or (None, None)
    return "" if mean is None else f"{mean}" if sem is None else f"{mean} ± {sem}"


def _with_published(table: Table, place: Place) -> str:
    text = _published(table, place)
    return _value(table, place, "accuracy") + (f" [{text}]" if text else "")


def _caveats(table: Table) -> list[str]:
    rows, columns = ({h.key: h.title for h in part} for part in table.headings)
    cells: dict[str, list[str]] = {}
    for row, column in table.cells:
        for mark in table.marks((row, column)):
            cells.setdefault(mark, []).append(f"{rows[row]} on {columns[column]}")
    return [f"{mark}: {'; '.join(places)}" for mark, places in cells.items()]


def _kept(table: Table, column: Heading) -> pd.DataFrame:
    """Return the clouds kept in the last round, mean over seeds, of each line that has rounds.

    A round that keeps fewer than two clouds a class leaves the network as it is: a line without a
    round that trained is the network before the rounds.
    """
    lines: list[dict[str, str]] = []
    for row in table.headings[0]:
        records = table.records_of((row.key, column.key))
        last = [record.rounds[-1] for record in records if record.rounds]
        if not last:
            continue
        counts = pd.DataFrame([done["kept"] for done in last]).mean()
        right = [""] * len(counts)
        if all("right" in done for done in last):
            means = pd.DataFrame([done["right"] for done in last]).mean()
            right = [f" / {mean:.1f}" for mean in means]
        confident = sum(sum(done["confident"]) for done in last) / len(last)
        trained, rounds = count_rounds(records)
        names = records[0].scores.class_names
        lines.append(
            {"method": row.title}
            | {n: f"{c:.1f}{r}" for n, c, r in zip(names, counts, right, strict=True)}
            | {"kept of confident": f"{counts.sum():.1f} of {confident:.1f}"}
            | {"rounds that trained": f"{trained} of {rounds}"}
        )
    return pd.DataFrame(lines)


def _command(table: Table) -> str:
    setup = table.setup
    words = [f"qs3 reproduce {table.name} --out {setup.out.name} --scale {setup.scale.name}"]
    chosen = {"methods": table.rows, "tasks": table.columns, "seeds": setup.seeds}
    words += [f"--{name} {' '.join(map(str, keys))}" for name, keys in chosen.items() if keys]
    words += [f"--steps {setup.scale.optimiser_steps}"] if setup.scale.own_steps else []
    words += [f"--threads {setup.threads}"] if setup.threads not in (None, 1) else []
    for kind, own in setup.own.items():
        test = own.test.split if own.test else None
        words.append(f"--data {kind}={own.train.data.name}:{own.train.split or ''}:{test or ''}")
    return " ".join(words)


def _intro(table: Table) -> list[str]:
    setup, scale = table.setup, table.setup.scale
    runs = [run for cell in table.cells.values() for run in cell]
    # The same for all networks except their seed.
    train = next((run.train for run in runs if run.network != FOREST_MODEL), scale.train)
    sources = [run.source for run in runs if run.row != SUPERVISED]
    domains = dict.fromkeys([*sources, *(run.target for run in runs)])
    data = [data_of(domain, setup.own) for domain in domains]
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
        " ".join(
            ["; ".join(dict.fromkeys(domain.title for domain in data)) + ".", *_scored(table)]
        ),
    ]
    named = {d.title.partition(":")[0]: d.stands_for for d in data if d.stands_for}
    stand_ins = ", ".join(f"{title} for {name}" for title, name in named.items())
    if stand_ins:
        text.append(
            f"**Stand-ins, made here**: {stand_ins}. A simulator on both sides "
            "flatters, and the paper's figures are of its own data: a yardstick, no target."
        )
    if scale.own_steps:
        text.append(f"Each network is trained for {steps:,} steps, not for the scale's own number.")
    if scale.rounds and any(run.self_training is not None for run in runs):
        text.append(scale.describe_rounds())
    if scale.smoke:
        text.append(
            "Below 40 training objects a class, 256 points or the whole networks: shows that "
            "everything runs, ranks nothing."
        )
    return text


def _scored(table: Table) -> list[str]:
    setup = table.setup
    text = []
    if (setup.out / MARKER).is_file():
        shapes_alone = read_marker(setup.out).meshes == "shapes"
        meshes = "procedural shapes alone" if shapes_alone else "procedural and artists' meshes"
        text.append(f"Meshes: {meshes}.")
    runs = [run for cell in table.cells.values() for run in cell if run.name in table.records]
    clouds = {str(run.target): table.records[run.name].test.clouds for run in runs}
    if clouds:
        counts = [f"{count} clouds of {target}" for target, count in clouds.items()]
        text.append(f"Scored on {', '.join(counts)}.")
    return text
