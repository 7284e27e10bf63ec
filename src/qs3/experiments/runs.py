"""The grid: which runs make a table, and how large they are."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from typing import Any, Literal, get_args

from qs3.adaptation.names import MethodName, split_method
from qs3.errors import InputError
from qs3.training.config import PRESETS, SelfTrainingSettings, TrainSettings

Task = Literal["M-D", "S-D", "M-R", "S-R"]
"""Source and target. M: samples of the meshes' surfaces; S: scans of the same meshes by the
simulated sensor; D: scans of other meshes by another simulated sensor; R: real objects."""
ScaleName = Literal["smoke", "laptop", "small"]
"""Sizes of the bench; see `SCALES`."""

SUPERVISED = "supervised"
"""Row of the network that is trained on the labelled training part of the target."""
TABLE_ROWS: tuple[str, ...] = (
    SUPERVISED,
    "source-only",
    "pointdan",
    "defrec",
    "defrec-pcm",
    "gast",
    "gast-spst",
    "qbst",
)
"""The paper's rows; on scans ``qbst`` is QS³."""
FURTHER_ROWS: tuple[str, ...] = ("dann", "mmd", "coral", "sd", "spst")
"""Methods that the paper's table lacks."""
ROWS = (*TABLE_ROWS, *FURTHER_ROWS)
"""Rows of the bench, in the order of the table."""

ABLATIONS: Mapping[str, Mapping[str, Any]] = {
    "qbst": {},
    "qbst-least-confident": {"selection": "least-confident"},
    "qbst-scratch": {"init": "scratch"},
    "qbst-best-labeller": {"labeller": "best"},
    "qbst-no-source-loss": {"source_loss": False},
}
"""Rows of the ablation: what each changes in the settings of self-training."""

_FLOOR_OBJECTS, _FLOOR_POINTS = 40, 512


@dataclass(frozen=True)
class Scale:
    """Size of a bench: its data and its trainings."""

    name: str
    """Told in the title of the table."""
    source_per_class: int
    """Objects a class of the source, of which a tenth is held out for the validators."""
    target_per_class: int
    """Objects a class to adapt to."""
    test_per_class: int
    """Objects a class to score on."""
    common: tuple[str, ...] = ("chair", "table")
    """Classes that are frequent in the target, as in scans of rooms."""
    common_factor: int = 3
    """How many times as frequent."""
    source_views: int = 5
    """Views fused into a scan of the source."""
    samples: int = 4
    """Rays a pixel."""
    data_points: int = 2048
    """Points of each cloud on disk."""
    train: TrainSettings = field(default_factory=TrainSettings)
    """How networks are trained; the seed is a run's own."""
    rounds: Mapping[str, Any] = field(default_factory=dict)
    """Settings of self-training that differ from the preset of its rule."""
    tasks: tuple[Task, ...] = get_args(Task)
    """Tasks by default."""

    @property
    def smoke(self) -> bool:
        """Whether it lies below what a comparison of methods needs."""
        trained = self.source_per_class * (1 - self.train.holdout)
        small = trained < _FLOOR_OBJECTS or self.train.num_points < _FLOOR_POINTS
        return small or self.train.model != "dgcnn" or bool(self.train.model_settings)

    def train_with(self, threads: int | None, seed: int = 0) -> TrainSettings:
        """Return the settings of a training with a seed and a number of threads."""
        return replace(self.train, seed=seed, threads=threads)

    def target_count(self, class_name: str, per_class: int) -> int:
        """Return how many objects of a class stand in a part of the target."""
        return per_class * (self.common_factor if class_name in self.common else 1)


SCALES: Mapping[str, Scale] = {
    # One seed of M-D and S-D takes about a quarter of an hour on one core.
    "smoke": Scale(
        name="smoke",
        source_per_class=8,
        target_per_class=4,
        test_per_class=3,
        source_views=2,
        data_points=512,
        train=TrainSettings(
            model="dgcnn",
            model_settings={"neighbours": 10, "channels": (32, 32, 64, 64), "embedding": 256},
            num_points=256,
            epochs=12,
            batch_size=16,
            learning_rate=2e-3,
            validate_every=4,
        ),
        # Networks of so few clouds are seldom sure.
        rounds={"threshold": 0.4, "rounds": 3, "epochs": 2},
        tasks=("M-D", "S-D"),
    ),
    # Networks that learn something, in a few hours of one core; below the floor all the same.
    "laptop": Scale(
        name="laptop",
        source_per_class=16,
        target_per_class=6,
        test_per_class=6,
        source_views=3,
        data_points=512,
        train=TrainSettings(
            model="dgcnn",
            model_settings={"neighbours": 10, "channels": (32, 32, 64, 64), "embedding": 256},
            num_points=256,
            epochs=24,
            batch_size=16,
            learning_rate=2e-3,
            validate_every=8,
        ),
        rounds={"threshold": 0.6, "rounds": 4, "epochs": 3},
        tasks=("M-D", "S-D"),
    ),
    "small": Scale(
        name="small",
        source_per_class=48,
        target_per_class=20,
        test_per_class=20,
        train=TrainSettings(
            model="dgcnn", num_points=512, epochs=80, batch_size=16, validate_every=10
        ),
    ),
}
"""Sizes by name: ``small`` is the least on which methods may be compared."""


@dataclass(frozen=True)
class Run:
    """One training of the grid with its scores."""

    task: Task
    """Source and target."""
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

    @property
    def folder(self) -> str:
        """Folder of the run below that of all runs."""
        return f"{self.task}/{self.row}/seed-{self.seed}"

    @property
    def record(self) -> str:
        """Name of the record among the results."""
        return f"{self.task}_{self.row}_seed-{self.seed}.json"


def make_run(scale: Scale, task: Task, row: str, seed: int, threads: int | None = None) -> Run:
    """Return the run of a line of the bench or of the ablation.

    Raises:
        InputError: where the row is unknown.

    Example:
        >>> run = make_run(SCALES["smoke"], "S-D", "qbst", 0)
        >>> run.method, run.warm_up, run.record
        ('qs3', 'source-only', 'S-D_qbst_seed-0.json')
    """
    if row not in ROWS and row not in ABLATIONS:
        raise InputError(f"unknown row {row!r}; choose from {', '.join((*ROWS, *ABLATIONS))}")
    changes = ABLATIONS.get(row)
    method: Any = row
    if row == SUPERVISED:
        method = "source-only"
    elif changes is not None:
        method = "qs3" if task.startswith("S") else "qbst"
    base, rule = split_method(method)
    rounds = None
    if rule is not None:
        preset = PRESETS["spst" if rule == "spst" else "default"]
        rounds = replace(preset, **{**scale.rounds, **(changes or {})})
    return Run(
        task=task,
        row=row,
        seed=seed,
        method=method,
        train=scale.train_with(threads, seed),
        self_training=rounds,
        warm_up=None if rule is None else base,
    )


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
                    place: Task = "S-D"
                    if task.endswith("R"):
                        continue
                else:
                    place = task
                run = make_run(scale, place, row, seed, threads)
                if run.warm_up is not None:
                    warm = make_run(scale, place, run.warm_up, seed, threads)
                    runs.setdefault(warm.folder, warm)
                runs.setdefault(run.folder, run)
    return list(runs.values())
