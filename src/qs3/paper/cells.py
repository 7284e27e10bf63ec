"""Cells of result tables: each is one training and its score, with method, settings and data."""

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Any, Literal

from qs3.adaptation.names import split_method
from qs3.clouds.preparation import ROBUST
from qs3.errors import InputError
from qs3.paper.domains import Domain, Generated, Kind, Part, find_domain
from qs3.paper.names import WITHOUT_TARGET, MethodName
from qs3.paper.scales import VARIANTS, Scale
from qs3.paper.setup import Setup
from qs3.runs.run import FOREST_MODEL
from qs3.runs.settings import GENTLE, PRESETS, SelfTrainingSettings, TrainSettings

SUPERVISED = "supervised"
"""Row of the network that is trained on the labelled training part of the target."""
ORDINARY = "ordinary"
"""Row of a network that is trained on the source without the target. One training serves all test
sets and is the warm-up of all rounds that start from the source alone."""
PAPER = "qbst-paper"
"""Row of QBST as in the paper's text (preset ``paper``)."""
_IN_UNIT_BALL = ("defrec", "defrec-pcm")
"""Methods whose clouds are scaled to the unit ball, without their size as an input."""


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


_QBST = Row("qbst", warm_up=ORDINARY)
_PAPER = Row("qbst", "paper", ORDINARY)
ROWS: Mapping[str, Row] = {
    SUPERVISED: Row(),
    ORDINARY: Row(),
    "pointdan": Row("pointdan"),
    "defrec": Row("defrec"),
    "defrec-pcm": Row("defrec-pcm"),
    "gast": Row("gast"),
    "gast-spst": Row("gast-spst", "spst", "gast"),
    "spst": Row("spst", "spst", ORDINARY),
    "qbst": _QBST,
    # This variant lost least on real objects.
    "qbst-gentle": replace(_QBST, changes=GENTLE),
    "qbst-least-confident": replace(_QBST, changes={"selection": "least-confident"}),
    "qbst-scratch": replace(_QBST, changes={"init": "scratch"}),
    "qbst-best-labeller": replace(_QBST, changes={"teacher": "best"}),
    "qbst-no-source-loss": replace(_QBST, changes={"source_loss": False}),
    "qbst-released": Row("qbst", "released", ORDINARY),
    PAPER: _PAPER,
    # The paper's text with one change each.
    "qbst-paper-source-loss": replace(_PAPER, changes={"source_loss": True}),
    "qbst-paper-warm-up": replace(_PAPER, changes={"init": "warm-up"}),
    "qbst-paper-whole-pool": replace(_PAPER, changes={"pool": "all"}),
    "qbst-paper-long": replace(_PAPER, changes={"epochs": 40}),
}


@dataclass(frozen=True, kw_only=True)
class Cell:
    """One training with its score. Its fields identify it in its record."""

    source: Kind
    source_views: int | None = None
    source_sensor: str = ""
    target: Kind
    target_sensor: str = ""
    target_clouds: int | None = None
    """Number of clouds to adapt to; None takes all."""
    row: str
    """One of `ROWS`."""
    network: str = ""
    """Network of the tables of networks, or ``forest``; "" is the network of the bench."""
    seed: int = 0
    threshold: float | None = None
    step: float | None = None
    """Settings of the rounds that differ from the row's."""
    steps: int | None = None
    """Approximate steps of its training that differ from the scale's."""

    @property
    def fields(self) -> dict[str, str | int | float]:
        """Fields that identify the cell in its record, without empty ones."""
        return {name: value for name, value in asdict(self).items() if value not in (None, "")}

    @property
    def source_name(self) -> str:
        """Name of the source in folders, such as V3; nothing reads it back."""
        return _name(f"{self.source}{self.source_views or ''}", self.source_sensor)

    @property
    def target_name(self) -> str:
        """Name of the target in tables, such as A.kinect_v1."""
        return _name(self.target, self.target_sensor)

    @property
    def _place(self) -> tuple[str, str]:
        # The source of the supervised row has always been written S.
        source = "S" if self.row == SUPERVISED else self.source_name
        values = {"theta": self.threshold, "step": self.step, "steps": self.steps}
        changed = [
            f"{name}-{value if isinstance(value, int) else f'{value:g}'}"
            for name, value in values.items()
            if value is not None
        ]
        label = "-".join([ROWS[self.row].method, *changed]) if changed else self.row
        task = f"{source}-{_name(self.target, self.target_sensor, self.target_clouds)}"
        return task, f"{label}@{self.network}" if self.network else label

    @property
    def name(self) -> str:
        """Name for messages; nothing reads it back."""
        return "_".join([*self._place, f"seed-{self.seed}"])

    @property
    def folder(self) -> Path:
        """Folder of the run in a reproduction; cells with the same training share it."""
        task, label = self._place
        place = self.source_name if self.row == ORDINARY else task
        return Path("runs", place, label, f"seed-{self.seed}")

    @property
    def warm_up(self) -> "Cell | None":
        """Cell whose network self-training starts from; None without rounds, and of a forest."""
        row = "" if self.network == FOREST_MODEL else ROWS[self.row].warm_up
        return replace(self, row=row, threshold=None, step=None) if row else None

    def domains(self, setup: Setup) -> tuple[Domain, Domain]:
        """Return the source and the target."""
        views, clouds = self.source_views, self.target_clouds
        return (
            find_domain(self.source, setup.data, views=views, sensor=self.source_sensor),
            find_domain(self.target, setup.data, clouds=clouds, sensor=self.target_sensor),
        )

    def parts(self, setup: Setup) -> tuple[Part, Part | None, Part]:
        """Return the clouds to train on, to adapt to (None without adaptation), and to score on."""
        source, target = self.domains(setup)
        if target.test is None:
            raise InputError(f"{self.name}: {self.target} has no clouds to score on")
        adapted_to = None if self.row in (SUPERVISED, ORDINARY) else target.train
        return source.train, adapted_to, target.test

    def training(self, setup: Setup) -> TrainSettings:
        """Return the settings of its training; the sizes of the data may determine the epochs."""
        scale, method = setup.scale, ROWS[self.row].method
        if self.network == FOREST_MODEL:  # the forest reads no other setting
            return TrainSettings(model=FOREST_MODEL, preparation=ROBUST, seed=self.seed)
        train = replace(scale.train, seed=self.seed, threads=setup.threads)
        if self.network:
            # PointDAN's own network belongs to the tables of methods and is trained like these.
            ordinary = {} if self.network == "pointnet-sa" else scale.ordinary
            model = self.network.removesuffix("-64")
            settings = {**scale.networks, **VARIANTS}[self.network]
            train = replace(train, model=model, model_settings=settings, **ordinary)
        steps = self.steps or scale.optimiser_steps
        if steps is not None:
            parts = [(self.source, self.domains(setup)[0].train)]
            if split_method(method)[0] not in WITHOUT_TARGET:
                parts.append((self.target, self.domains(setup)[1].train))
            counts = [scale.count_clouds(k) if p.count is None else p.count for k, p in parts]
            longest = max(counts[0] - int(train.holdout * counts[0]), *counts[1:], 1)
            batches = -(-longest // train.batch_size)
            train = replace(train, epochs=max(1, round(steps / batches)))
        if self.row == ORDINARY:  # the last epoch is used, so no checkpoints are needed
            train = replace(train, validate_every=0)
        if method in _IN_UNIT_BALL:
            train = replace(train, preparation=replace(train.preparation, size_input=False))
        return train

    def rounds(self, scale: Scale) -> SelfTrainingSettings | None:
        """Return the settings of its rounds; None without rounds."""
        row = ROWS[self.row]
        if not row.warm_up:
            return None
        rounds = dict(scale.rounds)
        if self.network == FOREST_MODEL:
            rounds.pop("epochs", None)  # a forest grows at once
        settings = {**rounds, **row.changes}
        if "threshold_share" in settings:
            settings.pop("threshold", None)
        thresholds = {"threshold": self.threshold, "step": self.step}
        settings |= {name: value for name, value in thresholds.items() if value is not None}
        return replace(PRESETS[row.preset], **settings)


def make_cell(setup: Setup, **fields: Any) -> Cell:
    """Return the cell of some fields, such that equal trainings give equal cells.

    The supervised row takes the target's own clouds as its source. A threshold or step equal to
    the row's is left out, so that the cell shares its training with the table of methods.

    Example:
        >>> from qs3.paper.scales import SCALES
        >>> setup = Setup(Path("bench"), SCALES["smoke"])
        >>> cell = make_cell(setup, source="S", target="D", row=PAPER, threshold=0.3)
        >>> cell.name, cell.rounds(setup.scale).pool
        ('S-D_qbst-theta-0.3_seed-0', 'shrinking')
    """
    if fields["row"] == SUPERVISED:
        fields["source"] = fields["target"]
    plain: dict[str, Any] = {**fields, "threshold": None, "step": None}
    usual = Cell(**plain).rounds(setup.scale)
    for name in ("threshold", "step"):
        if fields.get(name) == getattr(usual, name, None):
            fields[name] = None
    return Cell(**fields)


def data_sets_of(cells: Iterable[Cell], setup: Setup) -> list[Generated]:
    """Return the data sets to generate for some cells, each once."""
    data = [part.data for cell in cells for part in cell.parts(setup) if part is not None]
    return list(dict.fromkeys(each for each in data if not isinstance(each, Path)))


def _name(*parts: str | int | None) -> str:
    return ".".join(str(part) for part in parts if part).replace("-", "_")
