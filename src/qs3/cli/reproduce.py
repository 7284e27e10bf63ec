"""``qs3 reproduce``: make tables and figures, from data to records to files."""

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from qs3.cli.options import Flat
from qs3.cli.text import notify, show
from qs3.errors import InputError
from qs3.paper import GALLERIES, TABLES, ScaleName

ProductName = str
if not TYPE_CHECKING:
    ProductName = tyro.extras.literal_type_from_choices((*TABLES, GALLERIES))


@dataclass(frozen=True)
class ReproduceOptions:
    """Make tables and figures: data, trainings, records, files; resumes after a stop."""

    names: Annotated[tuple[ProductName, ...], tyro.conf.Positional]
    """What to make; default: everything. ordinary, uda, real2sim, views, thresholds: the paper's;
    partiality, sensors, growth, adaptation-ablation: further tables;
    galleries: pictures of the domains."""
    out: Path
    """Folder; tables may share one, and the same command continues after a stop. With
    QS3_SHARED_DATA set, artists' meshes and real objects take part."""
    scale: ScaleName = "small"
    """smoke: shows that everything runs; laptop: the least that judges, days of processors; full:
    half the paper's target, of single views; small: the paper's preparation, hours on a GPU; paper:
    the paper's source, points and epochs, days."""
    steps: tuple[int, ...] = ()
    """Steps of each training before its rounds, in place of the scale's number, in whole epochs; a
    folder has one number. More numbers add rows to uda that train for so many, without rounds."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds of the trainings."""
    methods: tuple[str, ...] = ()
    """Lines of the tables; default: all."""
    tasks: tuple[str, ...] = ()
    """Columns of the tables, such as S-D; default: all. M surfaces, S scans, D simulated target, F
    the same objects without noise, R real objects of NYU Depth v2, U of SUN RGB-D."""
    data: tuple[str, ...] = ()
    """Your data in place of what is made here, as NAME=PATH or NAME=PATH:TRAIN:TEST with two
    splits: D=scans/depth."""
    dry_run: bool = False
    """Print the numbers of scans and runs; write nothing."""
    threads: int = 1
    """CPU threads of a training; results depend on them in the last bits."""
    workers: int = 2
    """Processes that scan and train."""


def reproduce(options: Flat[ReproduceOptions]) -> int:
    """Make tables and figures, with their data and trainings; only what is missing is done."""
    from qs3.checks import check_numbers
    from qs3.paper.domains import parse_data
    from qs3.paper.reproduce import choose_tables
    from qs3.paper.reproduce import reproduce as make
    from qs3.paper.scales import SCALES
    from qs3.paper.setup import Setup, count_data

    check_numbers("--threads", options.threads)
    shared = os.environ.get("QS3_SHARED_DATA")
    if shared and not Path(shared).is_dir():
        raise InputError(f"QS3_SHARED_DATA: {shared} is no folder; correct it, or unset it")
    scale = SCALES[options.scale]
    if not options.seeds:
        raise InputError("--seeds: name at least one")
    if options.steps:
        check_numbers("--steps", options.steps)
        first, *more = dict.fromkeys(options.steps)
        scale = replace(scale, optimiser_steps=first, more_steps=tuple(more))
    setup = Setup(
        out=options.out,
        scale=scale,
        seeds=tuple(dict.fromkeys(options.seeds)),
        threads=options.threads,
        shared=Path(shared) if shared else None,
        data=count_data(parse_data(options.data), scale),
    )
    names = options.names or (*TABLES, GALLERIES)
    tables = [name for name in names if name != GALLERIES]
    chosen = choose_tables(tables, setup, options.methods, options.tasks)
    print_lines = show if options.dry_run else notify
    paths = make(chosen, setup, print_lines, options.workers, GALLERIES in names, options.dry_run)
    show(*(path.read_text(encoding="utf-8") for path in paths if path.is_file()))
    notify(*(f"made: {path}" for path in paths))
    return 0
