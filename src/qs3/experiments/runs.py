"""Runs as fields: what each trains, on what, and where its record lies."""

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field, replace
from typing import Any, Literal

from qs3.adaptation.names import WITHOUT_TARGET, MethodName, split_method
from qs3.errors import InputError, no_such
from qs3.experiments.domains import Domain, Own, Part, data_of
from qs3.experiments.scales import Scale
from qs3.training.config import GENTLE, PRESETS, SelfTrainingSettings, TrainSettings

SUPERVISED = "supervised"
"""Row of the network that is trained on the labelled training part of the target."""
ORDINARY = "ordinary"
"""Row of a network that is trained on the source and sees no cloud of the target: one training
serves all test sets, and is the warm-up of all rounds that start from the source alone."""
PAPER = "qbst-paper"
"""Row of QBST as the paper's text has it (preset ``paper``)."""


@dataclass(frozen=True)
class Row:
    """How the networks of a line of a table are trained."""

    method: MethodName = "source-only"
    """Method of adaptation."""
    preset: Literal["default", "spst", "paper"] = "default"
    """Settings of the rounds of self-training."""
    warm_up: str = ""
    """Row whose network self-training starts from; empty without rounds."""
    changes: Mapping[str, Any] = field(default_factory=dict)
    """Settings of the rounds that differ from the preset."""
    sized: bool = True
    """Whether the network may be told sizes; a method in the unit ball knows none."""


_QBST = Row("qbst", warm_up=ORDINARY)
ROWS: Mapping[str, Row] = {
    SUPERVISED: Row(),
    "source-only": Row(),
    "pointdan": Row("pointdan"),
    "defrec": Row("defrec", sized=False),
    "defrec-pcm": Row("defrec-pcm", sized=False),
    "gast": Row("gast"),
    "gast-spst": Row("gast-spst", "spst", "gast"),
    "qbst": _QBST,
    "dann": Row("dann"),
    "spst": Row("spst", "spst", ORDINARY),
    # What lost least on real objects.
    "qbst-gentle": replace(_QBST, changes=GENTLE),
    "qbst-least-confident": replace(_QBST, changes={"selection": "least-confident"}),
    "qbst-scratch": replace(_QBST, changes={"init": "scratch"}),
    "qbst-best-labeller": replace(_QBST, changes={"teacher": "best"}),
    "qbst-no-source-loss": replace(_QBST, changes={"source_loss": False}),
    ORDINARY: Row(),
    PAPER: Row("qbst", "paper", ORDINARY),
}
"""Every line by name."""


@dataclass(frozen=True)
class Run:
    """One training of a grid with its scores."""

    source: Domain
    """Whose labels it learns."""
    target: Domain
    """What it is adapted to, or the test set alone; on its test part the run is scored."""
    row: str
    """How it is trained: one of `ROWS`."""
    seed: int
    """Root of all random steps."""
    train: TrainSettings
    """How the network is trained."""
    self_training: SelfTrainingSettings | None = None
    """How it trains itself; None without rounds."""
    network: str = ""
    """Network of the tables of networks; "" is that of the bench."""
    changes: Mapping[str, float] = field(default_factory=dict)
    """Settings of the rounds in which it differs from its row."""

    @property
    def kind(self) -> Row:
        """How networks of its row are trained."""
        return ROWS[self.row]

    @property
    def fields(self) -> dict[str, str | int | float]:
        """What the run is known by in its record, beside its settings; what is empty is left out.

        Example:
            >>> from qs3.experiments.scales import SCALES
            >>> make_run(SCALES["smoke"], Domain("V", views=3), Domain("D"), "ordinary").fields
            {'source': 'V', 'source_views': 3, 'target': 'D', 'row': 'ordinary', 'seed': 0}
        """
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
    def folder(self) -> str:
        """Folder of the run below that of all runs."""
        place = str(self.source) if self.row == ORDINARY else self._task
        return f"{place}/{self._label}/seed-{self.seed}"

    @property
    def name(self) -> str:
        """Name of its record; people read it, the program compares it and takes nothing from it."""
        return f"{self._task}_{self._label}_seed-{self.seed}"

    @property
    def _task(self) -> str:
        # Of the supervised row the source has always been written S.
        return f"{'S' if self.row == SUPERVISED else self.source}-{self.target}"

    @property
    def _label(self) -> str:
        words = {"threshold": "theta"}
        changed = [f"{words.get(name, name)}-{value:g}" for name, value in self.changes.items()]
        label = "-".join([self.kind.method, *changed]) if changed else self.row
        return f"{label}@{self.network}" if self.network else label

    def parts(self, own: Own | None = None) -> tuple[Part, Part | None, Part]:
        """Return the clouds to learn from, to adapt to (None where it sees none), to score on.

        Raises:
            InputError: where the target has no clouds to score on.
        """
        learnt, target = data_of(self.source, own), data_of(self.target, own)
        if target.test is None:
            raise InputError(f"task {self._task}: {self.target} has no clouds to score on")
        adapted_to = None if self.row in (SUPERVISED, ORDINARY) else target.train
        return learnt.train, adapted_to, target.test


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

    Args:
        scale: How large.
        source: Whose labels it learns; for the supervised row the target's own take its place.
        target: What it is adapted to and scored on.
        row: How it is trained: one of `ROWS`.
        seed: Root of all random steps.
        threads: CPU threads.
        network: Network of the tables of networks; "" is that of the bench.
        own: The user's data sets, whose sizes may decide the epochs.
        changes: Settings of the rounds that differ from the row's; those that do not are left out,
            so that a cell with the row's own value is one training with the table of methods.

    Raises:
        InputError: where the row or the network is unknown.

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
    alone = split_method(kind.method)[0] in WITHOUT_TARGET
    adapted_to = 0 if alone else _count(scale, target, own)
    train = scale.train_with(threads, seed, network, _count(scale, source, own), adapted_to)
    if row == ORDINARY:
        # The last network is taken; it needs no checkpoints.
        train = replace(train, validate_every=0)
    if not kind.sized:
        train = replace(train, preparation=replace(train.preparation, size_input=False))
    rounds = None
    if kind.warm_up:
        own = {**scale.rounds, **kind.changes}
        if "threshold_share" in own:
            own.pop("threshold", None)
        usual = replace(PRESETS[kind.preset], **own)
        changes = {name: value for name, value in changes.items() if getattr(usual, name) != value}
        rounds = replace(usual, **changes)
    return Run(source, target, row, seed, train, rounds, network, changes)


def _count(scale: Scale, domain: Domain, own: Own | None) -> int:
    """Return how many clouds a domain has to train on."""
    count = data_of(domain, own).train.count
    return scale.count_clouds(domain.kind) if count is None else count


def warm_up_of(scale: Scale, run: Run, own: Own | None = None) -> Run | None:
    """Return the run that self-training starts from; None without rounds."""
    row = run.kind.warm_up
    if not row:
        return None
    threads = run.train.threads if isinstance(run.train.threads, int) else None
    return make_run(scale, run.source, run.target, row, run.seed, threads, run.network, own)
