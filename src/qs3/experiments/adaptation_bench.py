"""The bench of adaptation: every method on scans and on surfaces, from data made here.

Paper: Table of adaptation methods of QS³ (ECCV 2022), whose figures stand beside ours.
Command: ``qs3 reproduce adaptation-bench --out DIR`` (``--dry-run`` prints counts and hours).
"""

import dataclasses
import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from qs3.datasets.estimate import estimate
from qs3.datasets.manifest import MANIFEST
from qs3.datasets.plan import Plan
from qs3.errors import InputError
from qs3.experiments.bench_data import REAL_CLOUDS, make_data, make_plans
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
from qs3.experiments.cost import Counts, methods_of, run_seconds, step_seconds
from qs3.experiments.grid import (
    DATA,
    RESULTS,
    Evaluate,
    Tell,
    Train,
    has_real,
    make_work,
    missing,
    read_result,
    run_grid,
)
from qs3.experiments.runs import ABLATIONS, ROWS, SUPERVISED, Run, Scale, Task, make_grid
from qs3.files import claim_folder, read_json, write_json, write_text

MARKER = "bench.json"
Name = Literal["adaptation-bench", "adaptation-ablation"]
"""The tables: all methods, or the switches of QBST on one task."""
_ABLATION_TASK: Task = "S-D"


@dataclass(frozen=True)
class Bench:
    """A table that is to be made."""

    name: Name
    """Which one; also the name of its files."""
    out: Path
    """Folder of data, runs, records and table; both tables may share one."""
    scale: Scale
    """Size."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds of the trainings; the data are the same for all."""
    rows: tuple[str, ...] = ()
    """Lines; empty takes all."""
    tasks: tuple[Task, ...] = ()
    """Source and target of each part of the table; empty takes the scale's."""
    threads: int | None = None
    """CPU threads of a training."""
    workers: int = 2
    """Processes that scan."""
    shared: Path | None = None
    """Folder with artists' meshes and real objects; None takes procedural shapes alone."""

    def runs(self) -> list[Run]:
        """Return the grid.

        Raises:
            InputError: where a name is unknown, or a task needs real objects that are not here.
        """
        if self.name == "adaptation-ablation":
            if self.tasks:
                raise InputError(f"{self.name}: is made on {_ABLATION_TASK} alone; leave out tasks")
            rows: tuple[str, ...] = tuple(ABLATIONS)
            tasks: tuple[Task, ...] = (_ABLATION_TASK,)
        else:
            rows, tasks = ROWS, self.tasks or self.scale.tasks
            if not self.tasks and not has_real(self.shared):
                tasks = tuple(task for task in tasks if not task.endswith("R"))
        runs = make_grid(self.scale, self.rows or rows, tasks, self.seeds, self.threads)
        for run in runs:
            make_work(run, self.out, self.shared)  # refuses a task whose data is not there
        return runs


@dataclass(frozen=True)
class Cost:
    """What is left to do, in seconds."""

    data: float
    """Scanning."""
    runs: dict[str, float]
    """Each run of the grid, by its folder."""
    left: int
    """Runs without a record."""
    seconds: float
    """All that is left."""


def make_bench(bench: Bench, train: Train, evaluate: Evaluate, tell: Tell) -> Path:
    """Make the data, the runs and the table, whatever of them is missing.

    Args:
        bench: What to make.
        train: Trains a run.
        evaluate: Scores it.
        tell: Is told how it goes.

    Returns:
        The table.

    Raises:
        InputError: where the folder holds a bench of other settings, or a record is damaged or
            not of its run.
    """
    runs = bench.runs()
    plans = make_plans(bench.scale, bench.shared)
    _claim(bench, plans)
    missing(runs, bench.out)  # a damaged record stops here, not after hours
    cost = measure(bench, runs, plans)
    tell(describe(bench, runs, plans, cost))
    failed = make_data(bench.out / DATA, plans, bench.workers)
    for name, count in failed.items():
        if count:
            tell(f"{name}: {count} scans failed and are absent")
    run_grid(runs, bench.out, bench.shared, train, evaluate, tell, cost.runs)
    return write_table(bench, runs, plans)


def measure(bench: Bench, runs: Sequence[Run], plans: dict[str, Plan]) -> Cost:
    """Estimate what is left, from a few timed scans and a few timed steps of each method."""
    left = missing(runs, bench.out)
    rows = {name: plan.rows for name, plan in plans.items()}
    train = sum(item.split == "train" for item in plans["target"].items)
    # A warm-up is the cost of its own run; methods that no run needs are not timed.
    steps = step_seconds(methods_of(left), bench.scale.train_with(bench.threads)) if left else {}
    expected = {}
    for run in left:
        real = run.task.endswith("R")
        counts = Counts(
            source=train if run.row == SUPERVISED else rows["source"],
            target=REAL_CLOUDS if real else train,
            test=REAL_CLOUDS if real else rows["target"] - train,
        )
        expected[run.folder] = run_seconds(run, counts, steps)
    data = 0.0
    for name, plan in plans.items():
        if not (bench.out / DATA / name / MANIFEST).is_file():
            data += estimate(plan).seconds / max(bench.workers, 1)
    return Cost(data, expected, len(left), data + sum(expected.values()))


def describe(bench: Bench, runs: Sequence[Run], plans: dict[str, Plan], cost: Cost) -> str:
    """Say what will be made and how long it takes."""
    counts = ", ".join(f"{plan.rows} scans of the {name}" for name, plan in plans.items())
    return (
        f"{bench.name}, scale {bench.scale.name}: {counts}; {len(runs)} runs, {cost.left} of them "
        f"missing; about {cost.seconds / 3600:.2f} hours here, {cost.data / 3600:.2f} of them for "
        "scans"
    )


def _claim(bench: Bench, plans: dict[str, Plan]) -> None:
    """Write down what the folder is for, or check that it is for the same."""
    claim_folder(bench.out, MARKER)
    wanted = json.loads(
        json.dumps(
            {
                "scale": dataclasses.asdict(bench.scale),
                "threads": bench.threads,
                "meshes": plans["source"].settings.meshes,
            }
        )
    )
    path = bench.out / MARKER
    if not path.is_file():
        write_json(path, wanted)
        return
    there: Any = read_json(path)
    for name, value in wanted.items():
        if not isinstance(there, dict) or there.get(name) != value:
            raise InputError(f"{bench.out}: holds a bench of another {name}; name another --out")


def read_results(bench: Bench, runs: Sequence[Run]) -> list[Result]:
    """Read the records of the grid.

    Raises:
        InputError: where one is missing, damaged or of another run, or a file among them is no
            record of the bench.
    """
    folder = bench.out / RESULTS
    known = {run.record for run in runs}
    others = {
        run.record
        for seed in {int(path.stem.rpartition("-")[2]) for path in _numbered(folder)}
        for name in (*ROWS, *ABLATIONS)
        for task in ("M-D", "S-D", "M-R", "S-R")
        for run in make_grid(bench.scale, [name], [task], [seed], bench.threads)
    }
    for path in sorted(folder.iterdir()):
        if path.suffix == ".json" and path.name not in known | others:
            raise InputError(f"{path}: is no record of this bench; move it elsewhere")
    return [Result(run, read_result(folder / run.record, run)) for run in runs]


def _numbered(folder: Path) -> list[Path]:
    found = sorted(folder.glob("*_seed-*.json"))
    return [path for path in found if path.stem.rpartition("-")[2].isdecimal()]


def write_table(bench: Bench, runs: Sequence[Run], plans: dict[str, Plan]) -> Path:
    """Write the Markdown table and the CSV file from the records."""
    lines = group_results(read_results(bench, runs))
    order = bench.rows or (ROWS if bench.name == "adaptation-bench" else tuple(ABLATIONS))
    if bench.name == "adaptation-ablation":
        lines = [line for line in lines if line.row in order]
    scale, train = bench.scale, bench.scale.train
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
        f"trained on; seeds {', '.join(map(str, bench.seeds))}. Mean ± standard error (ddof = 1) "
        "over n seeds, made from the records alone. M: surfaces; S: scans by the sensor "
        f"{plans['source'].settings.sensor}; D: other meshes under "
        f"{plans['target'].settings.sensor}, on a floor, partly hidden; R: real SUN RGB-D objects.",
        "",
        "A simulator on both sides flatters: S and D share a renderer, so S-D is easier than a "
        "real target is.",
    ]
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
    path = bench.out / f"{bench.name}.md"
    write_text(path.with_suffix(".csv"), to_csv(lines))
    write_text(path, "\n".join(text))
    return path


def _settings(settings: Any) -> str:
    told = ", ".join(f"{name} {value}" for name, value in settings.items())
    return f"({told}) " if told else ""
