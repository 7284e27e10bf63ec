"""``qs3 reproduce``: make a table anew, from data to records to Markdown."""

import os
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

if TYPE_CHECKING:
    from qs3.experiments.grid import Work


@dataclass(frozen=True)
class ReproduceOptions:
    """Make a table anew: data, trainings, records, Markdown and CSV; resumes after a stop."""

    table: Annotated[Literal["adaptation-bench", "adaptation-ablation"], tyro.conf.Positional]
    """adaptation-bench: every method of adaptation; adaptation-ablation: the switches of QBST."""
    out: Path
    """Folder; both tables may share one. Run the same command again to go on after a stop. With
    QS3_SHARED_DATA set, artists' meshes and real objects take part."""
    scale: Literal["smoke", "laptop", "small"] = "small"
    """small: the least that ranks methods, hours on a GPU; laptop: hours on one core, networks
    that learn something; smoke: shows that everything runs."""
    seeds: tuple[int, ...] = (0, 1, 2)
    """Seeds of the trainings."""
    methods: tuple[str, ...] = ()
    """Lines of the table; all by default."""
    tasks: tuple[Literal["M-D", "S-D", "M-R", "S-R"], ...] = ()
    """M surfaces or S scans to D simulated or R real objects; by default what the scale has."""
    dry_run: bool = False
    """Print counts and hours, measured on a few scans and steps; write nothing."""
    threads: int | None = None
    """CPU threads of a training; numbers are the same for the same count."""
    workers: int = 2
    """Processes that scan."""


def reproduce(options: Annotated[ReproduceOptions, tyro.conf.arg(name="")]) -> int:
    """Make a table anew, with its data and its trainings; only what is missing is done."""
    from qs3.experiments.adaptation_bench import Bench, describe, make_bench, measure
    from qs3.experiments.bench_data import make_plans
    from qs3.experiments.runs import SCALES

    shared = os.environ.get("QS3_SHARED_DATA")
    bench = Bench(
        name=options.table,
        out=options.out,
        scale=SCALES[options.scale],
        seeds=options.seeds,
        rows=options.methods,
        tasks=options.tasks,
        threads=options.threads,
        workers=options.workers,
        shared=Path(shared) if shared else None,
    )
    if options.dry_run:
        runs, plans = bench.runs(), make_plans(bench.scale, bench.shared)
        print(describe(bench, runs, plans, measure(bench, runs, plans)))
        return 0
    path = make_bench(bench, _train, _evaluate, _tell)
    print(path.read_text(encoding="utf-8"))
    print(f"table: {path}", file=sys.stderr)
    return 0


def _tell(line: str) -> None:
    print(line, file=sys.stderr, flush=True)


def _train(work: "Work") -> None:
    from qs3.cli.train import TrainOptions, run
    from qs3.experiments.runs import SUPERVISED

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
            supervised=work.run.row == SUPERVISED,
            warm_up=work.warm_up,
            train=work.run.train,
            **told,
        )
    )


def _evaluate(work: "Work") -> Any:
    from qs3.cli.evaluate import make_record

    return make_record(work.out, work.test, work.test_split, checkpoints=True)[0]
