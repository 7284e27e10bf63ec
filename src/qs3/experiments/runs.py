"""Runs of the tables: method, settings, data and folder of each."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from qs3.adaptation.names import WITHOUT_TARGET, MethodName, split_method
from qs3.errors import InputError, no_such
from qs3.experiments.domains import Domain, Own, Part, data_of
from qs3.experiments.scales import Scale
from qs3.training.config import GENTLE, PRESETS, SelfTrainingSettings, TrainSettings
from qs3.training.run import FOREST_MODEL

RUNS = "runs"
"""Folder of the runs, in that of a reproduction."""
SUPERVISED = "supervised"
"""Row of the network that is trained on the labelled training part of the target."""
ORDINARY = "ordinary"
"""Row of a network that is trained on the source and sees no cloud of the target: one training
serves all test sets, and is the warm-up of all rounds that start from the source alone."""
PAPER = "qbst-paper"
"""Row of QBST as the paper's text has it (preset ``paper``)."""


@dataclass(frozen=True)
class Row:
    """Method and settings of a line of a table."""

    method: MethodName = "source-only"
    preset: Literal["default", "spst", "paper", "released"] = "default"
    """Settings of the rounds of self-training."""
    warm_up: str = ""
    """Row whose network self-training starts from; empty without rounds."""
    changes: Mapping[str, Any] = field(default_factory=dict)
    """Settings of the rounds that differ from the preset."""
    sized: bool = True
    """True if the network may know sizes; methods in the unit ball know none."""


_QBST = Row("qbst", warm_up=ORDINARY)
ROWS: Mapping[str, Row] = {
    SUPERVISED: Row(),
    "pointdan": Row("pointdan"),
    "defrec": Row("defrec", sized=False),
    "defrec-pcm": Row("defrec-pcm", sized=False),
    "gast": Row("gast"),
    "gast-spst": Row("gast-spst", "spst", "gast"),
    "qbst": _QBST,
    "dann": Row("dann"),
    "spst": Row("spst", "spst", ORDINARY),
    # Lost least on real objects.
    "qbst-gentle": replace(_QBST, changes=GENTLE),
    "qbst-least-confident": replace(_QBST, changes={"selection": "least-confident"}),
    "qbst-scratch": replace(_QBST, changes={"init": "scratch"}),
    "qbst-best-labeller": replace(_QBST, changes={"teacher": "best"}),
    "qbst-no-source-loss": replace(_QBST, changes={"source_loss": False}),
    ORDINARY: Row(),
    PAPER: Row("qbst", "paper", ORDINARY),
    "qbst-released": Row("qbst", "released", ORDINARY),
    # The paper's text with one change each.
    "qbst-paper-source-loss": Row("qbst", "paper", ORDINARY, {"source_loss": True}),
    "qbst-paper-warm-up": Row("qbst", "paper", ORDINARY, {"init": "warm-up"}),
    "qbst-paper-whole-pool": Row("qbst", "paper", ORDINARY, {"pool": "all"}),
    "qbst-paper-long": Row("qbst", "paper", ORDINARY, {"epochs": 40}),
}


@dataclass(frozen=True)
class Run:
    """One training of a grid with its scores."""

    source: Domain
    """Domain of the labelled clouds."""
    target: Domain
    """Domain to adapt to; its test part is scored."""
    row: str
    """One of `ROWS`."""
    seed: int
    train: TrainSettings
    self_training: SelfTrainingSettings | None
    """Settings of the rounds; None without rounds."""
    network: str
    """Network of the tables of networks, or ``forest``; "" is the network of the bench."""
    changes: Mapping[str, float]
    """Settings of the rounds that differ from the row's."""
    parts: tuple[Part, Part | None, Part]
    """Clouds to learn from, to adapt to (None if it sees none), and to score on."""
    warm_up: "Run | None"
    """Run whose network self-training starts from; None without rounds."""

    @property
    def kind(self) -> Row:
        """Method and settings of its row."""
        return ROWS[self.row]

    @property
    def fields(self) -> dict[str, str | int | float]:
        """Fields that identify the run in its record, without empty ones."""
        values: dict[str, Any] = {}
        for name, domain in (("source", self.source), ("target", self.target)):
            kind, *rest = asdict(domain).items()
            values |= {name: kind[1]} | {f"{name}_{key}": value for key, value in rest}
        values |= {"row": self.row, "network": self.network}
        return {name: value for name, value in values.items() if value} | {
            "seed": self.seed,
            **self.changes,
        }

    @property
    def key(self) -> frozenset[tuple[str, str | int | float]]:
        """Return `fields` as a key."""
        return frozenset(self.fields.items())

    @property
    def folder(self) -> str:
        """Folder of the run below that of all runs."""
        place = str(self.source) if self.row == ORDINARY else self._task
        return f"{place}/{self._label}/seed-{self.seed}"

    def place(self, out: Path) -> Path:
        """Return the folder of the run in a reproduction."""
        return out / RUNS / self.folder

    @property
    def name(self) -> str:
        """Name for messages; nothing reads it back."""
        return f"{self._task}_{self._label}_seed-{self.seed}"

    @property
    def _task(self) -> str:
        # The source of the supervised row has always been written S.
        return f"{'S' if self.row == SUPERVISED else self.source}-{self.target}"

    @property
    def _label(self) -> str:
        words = {"threshold": "theta"}
        changed = [f"{words.get(name, name)}-{value:g}" for name, value in self.changes.items()]
        label = "-".join([self.kind.method, *changed]) if changed else self.row
        return f"{label}@{self.network}" if self.network else label


def make_run(
    scale: Scale,
    source: Domain,
    target: Domain,
    row: str,
    seed: int = 0,
    threads: int | None = None,
    network: str = "",
    own: Own | None = None,
    **changes: float,
) -> Run:
    """Return the run of a cell of a table.

    The supervised row takes the target's own clouds as its source. ``changes`` are settings of the
    rounds that differ from the row's; equal ones are left out, so that such a cell shares its
    training with the table of methods. Sizes of the user's ``own`` data may decide the epochs.

    Example:
        >>> from qs3.experiments.scales import SCALES
        >>> run = make_run(SCALES["smoke"], Domain("S"), Domain("D"), PAPER, threshold=0.3)
        >>> run.name, run.folder, run.self_training.pool
        ('S-D_qbst-theta-0.3_seed-0', 'S-D/qbst-theta-0.3/seed-0', 'shrinking')
    """
    if row not in ROWS:
        raise no_such(f"unknown row {row!r}", row, ROWS)
    kind = ROWS[row]
    source = target if row == SUPERVISED else source
    learnt, scored = data_of(source, own), data_of(target, own)
    if scored.test is None:
        raise InputError(f"task {source}-{target}: {target} has no clouds to score on")
    adapted_to = None if row in (SUPERVISED, ORDINARY) else scored.train
    counts = [_count(scale, source, learnt.train)]
    if split_method(kind.method)[0] not in WITHOUT_TARGET:
        counts.append(_count(scale, target, scored.train))
    train = scale.train_with(threads, seed, network, *counts)
    if row == ORDINARY and network != FOREST_MODEL:
        # The last network is taken; it needs no checkpoints.
        train = replace(train, validate_every=0)
    if not kind.sized:
        train = replace(train, preparation=replace(train.preparation, size_input=False))
    rounds = warm_up = None
    if kind.warm_up:
        warm_up = make_run(scale, source, target, kind.warm_up, seed, threads, network, own)
        settings = {**scale.rounds, **kind.changes}
        if "threshold_share" in settings:
            settings.pop("threshold", None)
        usual = replace(PRESETS[kind.preset], **settings)
        changes = {name: value for name, value in changes.items() if getattr(usual, name) != value}
        rounds = replace(usual, **changes)
    parts = learnt.train, adapted_to, scored.test
    return Run(source, target, row, seed, train, rounds, network, changes, parts, warm_up)


def _count(scale: Scale, domain: Domain, part: Part) -> int:
    return scale.count_clouds(domain.kind) if part.count is None else part.count
