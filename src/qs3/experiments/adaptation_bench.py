"""The bench of adaptation: every method on scans and on surfaces, from data made here.

Paper: Table of adaptation methods of QS³ (ECCV 2022), whose figures stand beside ours.
Command: ``qs3 reproduce adaptation-bench --out DIR`` (``--dry-run`` prints counts and hours).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from qs3.errors import InputError
from qs3.experiments.bench_data import SOURCE, TARGET, make_plans
from qs3.experiments.bench_table import (
    Result,
    group_results,
    published,
    reading,
    rule_table,
    score_table,
    selection_table,
    to_csv,
)
from qs3.experiments.grid import (
    RESULTS,
    Evaluate,
    Tell,
    Train,
    has_real,
    make_work,
    read_result,
)
from qs3.experiments.reproduction import reproduce
from qs3.experiments.rows import ABLATIONS, ROWS, SUPERVISED
from qs3.experiments.runs import Run, make_grid, parse_record_name
from qs3.experiments.scales import Task
from qs3.experiments.setup import Setup
from qs3.files import write_text
from qs3.store.plan import Plan

Name = Literal["adaptation-bench", "adaptation-ablation"]
"""The tables: all methods, or the switches of QBST on one task."""
_ABLATION_TASK: Task = "S-D"


@dataclass(frozen=True)
class Bench:
    """A table that is to be made; one of the parts of `qs3.experiments.reproduction`."""

    name: Name
    """Which one; also the name of its files."""
    setup: Setup
    """Where and how large; both tables may share one folder."""
    rows: tuple[str, ...] = ()
    """Lines; empty takes all."""
    tasks: tuple[Task, ...] = ()
    """Source and target of each part of the table; empty takes the scale's."""

    def runs(self) -> list[Run]:
        """Return the grid.

        Raises:
            InputError: where a name is unknown, or a task needs real objects that are not here.
        """
        setup = self.setup
        if setup.own:
            raise InputError(f"{self.name}: is made of its own data; leave out --data")
        if self.name == "adaptation-ablation":
            if self.tasks:
                raise InputError(f"{self.name}: is made on {_ABLATION_TASK} alone; leave out tasks")
            rows: tuple[str, ...] = tuple(ABLATIONS)
            tasks: tuple[Task, ...] = (_ABLATION_TASK,)
        else:
            rows, tasks = ROWS, self.tasks or setup.scale.tasks
            if not self.tasks and not has_real(setup.shared):
                tasks = tuple(task for task in tasks if not task.endswith("R"))
        runs = make_grid(setup.scale, self.rows or rows, tasks, setup.seeds, setup.threads)
        for run in runs:
            make_work(run, setup.out, setup.shared, setup.own)  # refuses what has no data
        return runs

    def sets(self) -> list[str]:
        """Return no data sets: the table is made of records."""
        return []

    def write(self) -> Path:
        """Write the Markdown table and the CSV file from the records."""
        setup = self.setup
        plans = make_plans(setup.scale, setup.shared, sets=[SOURCE, TARGET])
        return write_table(self, self.runs(), plans)


def make_bench(bench: Bench, train: Train, evaluate: Evaluate, tell: Tell) -> Path:
    """Make the data, the runs and the table, whatever of them is missing.

    The arguments and faults are those of `qs3.experiments.reproduction.reproduce`.
    """
    return reproduce([bench], bench.setup, train, evaluate, tell)[0]


def read_results(bench: Bench, runs: Sequence[Run]) -> list[Result]:
    """Read the records of the grid.

    Raises:
        InputError: where one is missing, damaged or of another run, or a file among them is no
            record of the bench.
    """
    folder, setup = bench.setup.out / RESULTS, bench.setup
    for path in sorted(folder.iterdir()):
        # The other tables' records lie here too; each is checked by its own.
        if path.suffix == ".json" and parse_record_name(path.name) is None:
            raise InputError(f"{path}: is no record of this bench; move it elsewhere")
    return [Result(run, read_result(folder / run.record, run, setup.own)) for run in runs]


def write_table(bench: Bench, runs: Sequence[Run], plans: Mapping[str, Plan]) -> Path:
    """Write the Markdown table and the CSV file from the records."""
    lines = group_results(read_results(bench, runs))
    order = bench.rows or (ROWS if bench.name == "adaptation-bench" else tuple(ABLATIONS))
    if bench.name == "adaptation-ablation":
        lines = [line for line in lines if line.row in order]
    scale, train = bench.setup.scale, bench.setup.scale.train
    smoke = "*smoke* — " if scale.smoke else ""
    shapes_only = plans["source"].settings.meshes == "shapes"
    meshes = "procedural shapes only" if shapes_only else "procedural shapes and artists' meshes"
    title = {
        "adaptation-bench": "Adaptation bench",
        "adaptation-ablation": "Ablation of QBST",
    }[bench.name]
    counts = {name: plan.rows for name, plan in plans.items()}
    text = [
        f"# {smoke}{title} ({meshes})",
        "",
        f"Scale {scale.name}: {train.model} {_settings(train.model_settings)}on "
        f"{train.num_points} points, {train.epochs} epochs; "
        f"{counts['source']} objects of the source ({scale.source_views} views), "
        f"{counts['target']} of the target (one view), of which "
        f"{sum(item.split == 'test' for item in plans['target'].items)} are scored and never "
        f"trained on; seeds {', '.join(map(str, bench.setup.seeds))}. Mean ± standard error "
        "(ddof = 1) over n seeds, made from the records alone. M: surfaces; S: scans by the sensor "
        f"{plans['source'].settings.sensor}; D: other meshes under "
        f"{plans['target'].settings.sensor}, on a floor, partly hidden; R: real SUN RGB-D objects.",
        "",
        "A simulator on both sides flatters: S and D share a renderer, so S-D is easier than a "
        "real target is.",
    ]
    if told := scale.rounds_told():
        text.append(told)
    if scale.smoke:
        text.append(
            "Below 40 training objects a class, 512 points or the whole DGCNN: shows that "
            "everything runs, ranks nothing."
        )
    adapted = [line.task for line in lines if line.row != SUPERVISED]
    for task in dict.fromkeys(adapted or [line.task for line in lines]):
        part = [line for line in lines if line.task == task]
        if task == "M-D":  # trained on the target's own labels: one for both sources
            part = [line for line in lines if line.row == SUPERVISED] + part
        part.sort(key=lambda line: order.index(line.row) if line.row in order else -1)
        text += ["", f"## {task[0]} → {task[-1]}", "", score_table(part)]
        text += ["", "Accuracy % at the checkpoint that each rule chooses:", "", rule_table(part)]
        text += ["", "\\* looks at the labels of the scored clouds: an upper bound, not a rule."]
        kept = selection_table(part)
        if kept is not None:
            text += ["", "Clouds kept in the last round, by pseudo label:", "", kept]
    said = reading(lines)
    if said:
        text += ["", "## Reading", "", *(f"- {line}" for line in said)]
    text += ["", f"Paper: {published()['source']}; other data, so a yardstick and no target.", ""]
    path = bench.setup.out / f"{bench.name}.md"
    write_text(path.with_suffix(".csv"), to_csv(lines))
    write_text(path, "\n".join(text))
    return path


def _settings(settings: Any) -> str:
    told = ", ".join(f"{name} {value}" for name, value in settings.items())
    return f"({told}) " if told else ""
