"""``qs3 reproduce``: tables and figures anew, from data to records to files."""

import os
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args

import tyro

from qs3.errors import InputError
from qs3.experiments.catalogue import PartName, ScaleName

if TYPE_CHECKING:
    from qs3.experiments.grid import Work
    from qs3.experiments.reproduction import Part
    from qs3.experiments.setup import Setup


@dataclass(frozen=True)
class ReproduceOptions:
    """Make tables and figures anew: data, trainings, records, files; resumes after a stop."""

    names: Annotated[tuple[PartName, ...], tyro.conf.Positional]
    """What to make; everything by default. ordinary, uda, real2sim, views, thresholds: the
    paper's; partiality, sensors, pointda10: further tables; galleries: pictures of the domains;
    adaptation-bench, adaptation-ablation: all methods, every rule of selection."""
    out: Path
    """Folder; all may share one. Run the same command again to go on after a stop. With
    QS3_SHARED_DATA set, artists' meshes and real objects take part."""
    scale: ScaleName = "small"
    """smoke: shows that everything runs; laptop: hours on one core, networks that learn something;
    small: the least that ranks methods, hours on a GPU; paper: the paper's size, days."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds of the trainings."""
    methods: tuple[str, ...] = ()
    """Lines of the tables; all by default."""
    tasks: tuple[str, ...] = ()
    """Columns of the tables, such as S-D; all by default. M surfaces, S scans, D simulated target,
    F its noise-free fusion, R real objects."""
    data: tuple[str, ...] = ()
    """Data sets of yours in place of what is made here, as NAME=PATH or NAME=PATH:TRAIN:TEST with
    two parts of it: D=scans/depth."""
    dry_run: bool = False
    """Print counts and hours, measured on a few scans and steps; write nothing."""
    threads: int = 1
    """CPU threads of a training; numbers are the same for the same count."""
    workers: int = 2
    """Processes that scan, and that train where no device is named."""
    devices: tuple[str, ...] = ()
    """GPUs by index; each makes one run at a time, in a process of its own."""
    executor: Literal["local", "ray"] = "local"
    """Where runs are made: here, or on a Ray cluster whose machines all see --out."""
    address: str = "auto"
    """Of the Ray cluster's head; auto is the one that this machine belongs to, local starts one."""


def reproduce(options: Annotated[ReproduceOptions, tyro.conf.arg(name="")]) -> int:
    """Make tables and figures anew, with their data and trainings; only what is missing is done."""
    from qs3.experiments.reproduction import reproduce as make

    setup = _setup(options)
    tell = print if options.dry_run else _tell
    paths = make(_parts(options, setup), setup, _train, _evaluate, tell, options.dry_run)
    for path in paths:
        if path.is_file():
            print(path.read_text(encoding="utf-8"))
    for path in paths:
        print(f"made: {path}", file=sys.stderr)
    return 0


def _setup(options: ReproduceOptions) -> "Setup":
    from qs3.experiments.domains import parse_own
    from qs3.experiments.scales import SCALES
    from qs3.experiments.setup import Setup

    for device in options.devices:
        if not device.isdecimal():
            raise InputError(f"--devices {device}: name GPUs by index, such as 0 1")
    for name in ("threads", "workers"):
        if getattr(options, name) < 1:
            raise InputError(f"--{name} {getattr(options, name)}: must be at least 1")
    shared = os.environ.get("QS3_SHARED_DATA")
    return Setup(
        out=options.out,
        scale=SCALES[options.scale],
        seeds=options.seeds,
        threads=options.threads,
        workers=options.workers,
        devices=options.devices,
        executor=options.executor,
        address=options.address,
        shared=Path(shared) if shared else None,
        own=parse_own(options.data),
    )


def _parts(options: ReproduceOptions, setup: "Setup") -> "list[Part]":
    from qs3.experiments.adaptation_bench import Bench
    from qs3.experiments.galleries import Galleries
    from qs3.experiments.paper import EXPERIMENTS, PaperTable

    names = options.names or get_args(PartName)
    if len(set(names)) < len(names):
        raise InputError(f"{' '.join(names)}: name each once")
    if not options.seeds or len(set(options.seeds)) < len(options.seeds):
        raise InputError(f"--seeds {' '.join(map(str, options.seeds))}: name each once")
    _check_keys(names, options)
    parts: list[Part] = []
    for name in names:
        if name == "galleries":
            parts.append(Galleries(setup))
        elif name in ("adaptation-bench", "adaptation-ablation"):
            tasks: Any = options.tasks
            parts.append(Bench(name, setup, options.methods, tasks))
        else:
            parts.append(PaperTable(EXPERIMENTS[name], setup, options.methods, options.tasks))
    return parts


def _check_keys(names: Sequence[str], options: ReproduceOptions) -> None:
    """Refuse a line or a column that no table has."""
    from qs3.experiments.paper import EXPERIMENTS
    from qs3.experiments.rows import ABLATIONS, ROWS
    from qs3.experiments.scales import SCALES

    scale = SCALES[options.scale]
    rows = {*ROWS, *ABLATIONS} if any(name.startswith("adaptation-") for name in names) else set()
    columns = {"M-D", "S-D", "M-R", "S-R"} if "adaptation-bench" in names else set()
    for name in set(names) & set(EXPERIMENTS):
        rows |= {key for key, _ in EXPERIMENTS[name].rows(scale)}
        columns |= {key for key, _ in EXPERIMENTS[name].columns(scale)}
    for option, given, known in (
        ("methods", options.methods, rows),
        ("tasks", options.tasks, columns),
    ):
        for key in given:
            if key not in known:
                raise InputError(f"--{option} {key}: choose from {', '.join(sorted(known))}")


def _tell(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


def _train(work: "Work") -> None:
    from qs3.cli.train import TrainOptions, run
    from qs3.experiments.rows import SUPERVISED

    told: dict[str, Any] = {}
    if work.run.self_training is not None:
        told["self_training"] = work.run.self_training
    run(
        TrainOptions(
            source=str(work.source),
            out=work.out,
            method=work.run.method,
            target=None if work.target is None else str(work.target),
            source_split=work.source_split,
            target_split=work.target_split,
            source_cloud=work.source_cloud,
            target_cloud=work.target_cloud,
            supervised=work.run.row == SUPERVISED,
            warm_up=work.warm_up,
            train=work.run.train,
            **told,
        )
    )


def _evaluate(work: "Work") -> Any:
    from qs3.experiments.rows import ORDINARY
    from qs3.training import evaluate

    rated = work.run.row != ORDINARY
    return evaluate(
        work.out, work.test, split=work.test_split, cloud=work.test_cloud, checkpoints=rated
    )
