"""The grid: which runs make a table."""

import contextlib
import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

from qs3.adaptation.names import MethodName, split_method
from qs3.errors import InputError
from qs3.experiments.rows import ABLATIONS, ORDINARY, PAPER, ROWS, STEP, SUPERVISED, THETA
from qs3.experiments.scales import Scale, Task
from qs3.training.config import PRESETS, SelfTrainingSettings, TrainSettings

_RECORD_NAME = re.compile(r"(?P<task>[^-]+-.+)_(?P<label>[^_]+)_seed-(?P<seed>\d+)\.json")


@dataclass(frozen=True)
class Run:
    """One training of the grid with its scores."""

    task: str
    """Source and target, or source and test set: names of `qs3.experiments.domains`."""
    row: str
    """Line of the table."""
    seed: int
    """Root of all random steps."""
    method: MethodName
    """Method of adaptation."""
    train: TrainSettings
    """How the network is trained."""
    self_training: SelfTrainingSettings | None = None
    """How it trains itself; None without rounds."""
    warm_up: str | None = None
    """Row whose network self-training starts from."""
    network: str = ""
    """Network of the tables of networks; "" is that of the bench."""

    @property
    def source(self) -> str:
        """Name of the source."""
        return self.task.partition("-")[0]

    @property
    def target(self) -> str:
        """Name of the target, on whose test part the run is scored."""
        return self.task.partition("-")[2]

    @property
    def learns_from(self) -> str:
        """Name of the domain whose labels it learns: the target's own for the supervised row."""
        return self.target if self.row == SUPERVISED else self.source

    @property
    def sees_target(self) -> bool:
        """Whether its training is handed the target's clouds."""
        return self.row not in (SUPERVISED, ORDINARY)

    @property
    def label(self) -> str:
        """Row and, where it is not the bench's, network."""
        return f"{self.row}@{self.network}" if self.network else self.row

    @property
    def folder(self) -> str:
        """Folder of the run below that of all runs."""
        place = self.source if self.row == ORDINARY else self.task
        return f"{place}/{self.label}/seed-{self.seed}"

    @property
    def record(self) -> str:
        """Name of the record among the results."""
        return f"{self.task}_{self.label}_seed-{self.seed}.json"


def parse_record_name(name: str) -> tuple[str, str, int] | None:
    """Return task, label and seed of a record's file name; None where it is no such name.

    Example:
        >>> parse_record_name("A.kinect_v1-A.d435_ordinary@dgcnn_seed-0.json")
        ('A.kinect_v1-A.d435', 'ordinary@dgcnn', 0)
        >>> parse_record_name("test-0a1b.json") is None
        True
    """
    found = _RECORD_NAME.fullmatch(name)
    return None if found is None else (found["task"], found["label"], int(found["seed"]))


def make_run(
    scale: Scale,
    task: str,
    row: str,
    seed: int,
    threads: int | None = None,
    network: str = "",
) -> Run:
    """Return the run of a line of a table.

    Raises:
        InputError: where the row or the network is unknown.

    Example:
        >>> from qs3.experiments.scales import SCALES
        >>> run = make_run(SCALES["smoke"], "S-D", "qbst", 0)
        >>> run.method, run.warm_up, run.record
        ('qbst', 'source-only', 'S-D_qbst_seed-0.json')
        >>> make_run(SCALES["smoke"], "S-D", "ordinary", 0, network="rscnn").folder
        'S/ordinary@rscnn/seed-0'
    """
    changes, preset = _changes(row)
    method: Any = row
    if row in (SUPERVISED, ORDINARY):
        method = "source-only"
    elif changes is not None:
        method = "qbst"
    base, rule = split_method(method)
    rounds = warm_up = None
    if rule is not None:
        wanted = "spst" if rule == "spst" else preset
        rounds = replace(PRESETS[wanted], **{**scale.rounds, **(changes or {})})
        # The paper's tables have one training of the source alone for all targets.
        warm_up = ORDINARY if preset == "paper" else base
    train = scale.train_with(threads, seed, network)
    if row == ORDINARY:
        # No target that checkpoints could be rated on; the last network is taken.
        train = replace(train, validate_every=0)
    return Run(
        task=task,
        row=row,
        seed=seed,
        method=method,
        train=train,
        self_training=rounds,
        warm_up=warm_up,
        network=network,
    )


def _changes(row: str) -> tuple[Mapping[str, Any] | None, str]:
    """Return what a row of QBST changes (None for other rows), and in which preset."""
    if row == PAPER:
        return {}, "paper"
    for prefix, name in ((THETA, "threshold"), (STEP, "step")):
        if row.startswith(prefix):
            with contextlib.suppress(ValueError):
                return {name: float(row.removeprefix(prefix))}, "paper"
    if row in ABLATIONS:
        return ABLATIONS[row], "default"
    if row not in (*ROWS, ORDINARY):
        raise InputError(
            f"unknown row {row!r}; choose from {', '.join((*ROWS, *ABLATIONS, ORDINARY, PAPER))}"
        )
    return None, "default"


def make_grid(
    scale: Scale,
    rows: Sequence[str],
    tasks: Iterable[Task],
    seeds: Sequence[int],
    threads: int | None = None,
) -> list[Run]:
    """Return the runs of some rows, a warm-up before the runs that start from it.

    A seed is finished before the next begins. The supervised row is one for all tasks on D; real
    objects have none, as there are none to spare for a training.

    Raises:
        InputError: where a row, a task or a seed comes twice, or a row is unknown.

    Example:
        >>> from qs3.experiments.scales import SCALES
        >>> [run.row for run in make_grid(SCALES["smoke"], ["qbst"], ["S-D"], [0])]
        ['source-only', 'qbst']
    """
    tasks = list(tasks)
    for name, given in {"methods": rows, "tasks": tasks, "seeds": seeds}.items():
        if not given or len(set(given)) < len(given):
            raise InputError(f"--{name} {' '.join(map(str, given))}: name each once, at least one")
    runs: dict[str, Run] = {}
    for seed in seeds:
        for task in tasks:
            for row in rows:
                if row == SUPERVISED:
                    place: str = "S-D"
                    if task.endswith("R"):
                        continue
                else:
                    place = task
                for run in with_warm_up(scale, make_run(scale, place, row, seed, threads)):
                    runs.setdefault(run.record, run)
    return list(runs.values())


def with_warm_up(scale: Scale, run: Run) -> list[Run]:
    """Return the run, after the one that it starts from if there is such a one."""
    if run.warm_up is None:
        return [run]
    threads, network = run.train.threads, run.network
    return [make_run(scale, run.task, run.warm_up, run.seed, threads, network), run]
