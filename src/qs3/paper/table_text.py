"""A table as Markdown, CSV or LaTeX: which scores its cells hold, and how they are written."""

import math
import shlex
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pandas as pd

from qs3.evaluation.records import count_rounds
from qs3.evaluation.tables import SCORES, to_csv, to_latex, to_markdown
from qs3.paper import TableFormat
from qs3.paper.cells import SUPERVISED
from qs3.paper.domains import Domain
from qs3.paper.experiment import Heading
from qs3.paper.table import Place, Table
from qs3.runs.run import FOREST_MODEL
from qs3.runs.settings import PRESETS


def markdown(table: Table, whole_paths: bool = False) -> str:
    """Return the table as Markdown, with its data, caveats and comparisons.

    Files hold no path of a machine: there the command of waiting cells names the last part of the
    folder. With ``whole_paths`` it can be pasted.
    """
    experiment = table.experiment
    smoke = "*smoke* — " if table.setup.scale.smoke else ""
    blocks = [f"# {smoke}{experiment.title}", *_intro(table), *experiment.notes]
    blocks += ["Accuracy:", to_markdown(_scores(table, "accuracy", True))]
    blocks += ["Class-mean accuracy:", to_markdown(_scores(table, "class_mean_accuracy"))]
    if any(mean["seconds"] > 0 for mean in table.means.values()):
        blocks += [
            "CPU minutes of a run and its warm-up · CPU seconds for each point of its accuracy · "
            "steps of both · accuracy on its own source:",
            to_markdown(_scores(table, "cost")),
        ]
    for column in table.headings[1]:
        kept = _kept(table, column)
        if not kept.empty:
            head = f"{column.title}, clouds kept in the last round / right of them"
            blocks += [f"{head}, by pseudo label:", to_markdown(kept)]
    if table.waiting:
        blocks += [
            f"{len(table.waiting)} cells wait for runs (… or few seeds); this command makes them, "
            "and only what is missing:",
            f"    {_command(table, whole_paths)}",
        ]
    if caveats := _caveats(table):
        blocks += ["Caveats:", "\n".join(f"- {line}" for line in caveats)]
    if differences := table.differences():
        lines = (f"- {what}: {value.format()}" for what, value in differences)
        blocks += ["Differences, seed by seed:", "\n".join(lines)]
    return "\n\n".join([*blocks, f"Paper: {experiment.paper}"]) + "\n"


def csv(table: Table) -> str:
    """Return one line per run."""
    lines = table.lines.reindex(columns=["row", "column", "seed", *SCORES])
    places = list(zip(lines["row"], lines["column"], strict=True))
    paper = [table.experiment.published_cell(*place) or (None, None) for place in places]
    lines["paper_mean"], lines["paper_sem"] = ([cell[i] for cell in paper] for i in (0, 1))
    lines["marks"] = [", ".join(table.marks(place)) for place in places]
    return to_csv(lines)


def latex(table: Table) -> str:
    """Return the accuracies, and the paper's, as a LaTeX tabular."""
    smoke = "smoke: " if table.setup.scale.smoke else ""
    comments = [
        f"{smoke}{table.experiment.title}; accuracy, mean ± standard error over n seeds",
        f"Paper: {table.experiment.paper}",
        *_caveats(table),
    ]
    body = to_latex(_scores(table, "accuracy", with_published=True))
    return "\n".join([*(f"% {line}" for line in comments), body, ""])


FORMATS: dict[TableFormat, Callable[[Table], str]] = {"md": markdown, "csv": csv, "tex": latex}


def _scores(table: Table, score: str, with_published: bool = False) -> pd.DataFrame:
    rows, columns = table.headings
    parts = [pd.Series([row.title for row in rows], name=table.experiment.corner)]
    for column in columns:
        places = [(row.key, column.key) for row in rows]
        values = [_value(table, place, score) for place in places]
        parts.append(pd.Series(values, name=f"{column.title}, %"))
        printed = [table.experiment.published_cell(*place) for place in places]
        if with_published and any(printed):
            texts = ["{} ± {}".format(*cell) if cell else "–" for cell in printed]
            parts.append(pd.Series(texts, name="paper"))
    return pd.concat(parts, axis=1)


def _value(table: Table, place: Place, score: str) -> str:
    mean = table.means.get(place)
    if mean is None:
        return "…" if table.cells[place] else "–"
    if score == "cost":
        seconds, points = mean["seconds"], 100 * mean["accuracy"].mean
        on_source = mean["source_accuracy"]
        if math.isnan(seconds):
            return "–"
        each = f"{seconds / points:.1f}" if points else "–"
        fit = "–" if math.isnan(on_source) else f"{100 * on_source:.1f} %"
        return f"{seconds / 60:.1f} · {each} · {mean['steps']:,.0f} · {fit}"
    trained, rounds, text = mean["trained"], mean["rounds"], mean[score].format()
    if trained == rounds:
        return text
    return f"{text} ({f'{trained} of {rounds} rounds' if trained else 'no round'} trained)"


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
    lines = []
    for row in table.headings[0]:
        records = table.records_of((row.key, column.key))
        last = [record.rounds[-1] for record in records if record.rounds]
        if not last:
            continue
        counts = np.mean([done["kept"] for done in last], axis=0)
        texts = [f"{count:.1f}" for count in counts]
        if all("right" in done for done in last):
            right = np.mean([done["right"] for done in last], axis=0)
            texts = [f"{text} / {mean:.1f}" for text, mean in zip(texts, right, strict=True)]
        confident = np.mean([sum(done["confident"]) for done in last])
        trained, rounds = count_rounds(records)
        lines.append(
            {"method": row.title}
            | dict(zip(records[0].scores.class_names, texts, strict=True))
            | {"kept of confident": f"{counts.sum():.1f} of {confident:.1f}"}
            | {"rounds that trained": f"{trained} of {rounds}"}
        )
    return pd.DataFrame(lines)


def _command(table: Table, whole_paths: bool) -> str:
    setup = table.setup
    out = str(setup.out) if whole_paths else setup.out.resolve().name
    words = ["qs3", "reproduce", table.name, "--out", out, "--scale", setup.scale.name]
    chosen = {
        "methods": table.rows,
        "tasks": table.columns,
        "seeds": setup.seeds,
        "steps": [setup.scale.optimiser_steps, *setup.scale.more_steps]
        * (setup.scale.has_other_steps or bool(setup.scale.more_steps)),
        "threads": [setup.threads] * (setup.threads not in (None, 1)),
        "data": [_data_word(kind, domain, whole_paths) for kind, domain in setup.data.items()],
    }
    for name, keys in chosen.items():
        words += [f"--{name}", *map(str, keys)] if keys else []
    return shlex.join(words)


def _data_word(kind: str, domain: Domain, whole_paths: bool) -> str:
    """Return a word of ``--data``; a folder of records keeps the name of the data, not its path."""
    place, test = Path(domain.train.name), domain.test.split if domain.test else None
    if whole_paths:
        data = Path(str(domain.train.data))
        place = data if data.exists() else Path("PATH/TO") / place
    return f"{kind}={place}:{domain.train.split or ''}:{test or ''}"


def _intro(table: Table) -> list[str]:
    setup, scale, cells = table.setup, table.setup.scale, table.all_cells
    # The same for all networks except their seed.
    train = next((c.training(setup) for c in cells if c.network != FOREST_MODEL), scale.train)
    sources = [c.domains(setup)[0] for c in cells if c.row != SUPERVISED]
    domains = {d.title: d for d in [*sources, *(c.domains(setup)[1] for c in cells)]}
    steps = scale.optimiser_steps
    epochs = f"{train.epochs} epochs" if steps is None else f"about {steps:,} steps"
    has_source = any(domain.train.data == ("source",) for domain in domains.values())
    objects = f", {scale.source_per_class} objects a class of M and S" if has_source else ""
    text = [
        f"Scale {scale.name}{objects}: {train.num_points} points, "
        f"{epochs}, batches of {train.batch_size}, schedule cosine, network "
        f"{train.model} unless a line says otherwise; "
        f"seeds {', '.join(map(str, setup.seeds))}. Per cent, mean ± standard error "
        "(ddof = 1) over n seeds, from the records alone; the network is the last epoch's."
    ]
    if any(len(mean["seeds"]) == 1 for mean in table.means.values()):
        text[0] += " With one seed (n=1), brackets hold Wilson's 95 % interval over the clouds."
    text.append("; ".join(domains) + ".")
    if setup.meshes and any(not isinstance(d.train.data, Path) for d in domains.values()):
        alone = setup.meshes == "shapes"
        meshes = "procedural shapes alone" if alone else "procedural and artists' meshes"
        text[-1] += f" Meshes: {meshes}."
    clouds = {cell.target_name: record.test.clouds for cell, record in table.records.items()}
    if clouds:
        counts = (f"{count} clouds of {target}" for target, count in clouds.items())
        text[-1] += f" Scored on {', '.join(counts)}."
    stand_ins = {t.partition(":")[0]: d.stands_for for t, d in domains.items() if d.stands_for}
    if stand_ins:
        names = ", ".join(f"{title} for {name}" for title, name in stand_ins.items())
        text.append(
            f"**Stand-ins, made here**: {names}. A simulator on both sides "
            "flatters, and the paper's figures are of its own data: a yardstick, no target."
        )
    if scale.has_other_steps:
        text.append(f"Each network is trained for {steps:,} steps, not for the scale's own number.")
    if any(cell.steps for cell in cells):
        text.append("Rows that name a number of steps are trained for that many.")
    if scale.rounds and any(cell.warm_up for cell in cells):
        ours = ", ".join(f"{name} {value}" for name, value in scale.rounds.items())
        theirs = ", ".join(str(getattr(PRESETS["paper"], name)) for name in scale.rounds)
        text.append(f"Self-training here: {ours} (paper: {theirs}).")
    if scale.smoke:
        text.append(
            "Below 40 training objects a class, 256 points or the whole networks: shows that "
            "everything runs, ranks nothing."
        )
    return text
