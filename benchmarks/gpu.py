"""All that wants a GPU, in one command that can be repeated: see `STAGES` for what it does.

    python benchmarks/gpu.py [--out results/gpu] [--minutes 25] [--only scan grid]
    python benchmarks/gpu.py --cpu --tiny --out runs/tiny      every stage at toy size, on the CPU
    python benchmarks/gpu.py --dry-run                         tells the stages and their commands

Each stage is a process with a time limit of its own; one that fails or runs out of time does not
stop the others. It leaves ``NAME.json`` in the folder, and the whole ``summary.md``. Called again,
what is done stays, and a stage that was cut off goes on from what it had written. Logs, data sets
and runs lie in ``work/``, records of the grid's runs in ``results/``. ``QS3_SHARED_DATA`` names the
folder of real scans; without it the grid adapts to simulated scans by another sensor.
"""

import argparse
import itertools
import json
import os
import shlex
import signal
import statistics
import subprocess
import sys
import time
import xml.etree.ElementTree as ElementTree
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any, get_args

import numpy as np

HERE = Path(__file__).resolve().parent
SENSORS = ("paper", "d435")
SUMMARY = "summary.md"
GRACE = 15.0
"""Seconds that a stage has to end by itself once its time is up."""
Save = Callable[[dict], None]
"""Keeps what a stage has so far."""


@dataclass(frozen=True)
class Sizes:
    """How much is measured."""

    objects: int = 8
    """Objects that are scanned by each sensor, after one that warms up."""
    views: int = 5
    """Views of each."""
    batch: int = 32
    """Clouds in a step of a network, and in a training."""
    points: int = 1024
    """Points of a cloud in a step of a network; trainings have half."""
    rounds: int = 7
    """Steps of which the median is taken."""
    networks: tuple[str, ...] = ()
    """Networks; empty takes all that have a textbook form."""
    per_part: int = 8
    """Objects a class of each part of the source's data."""
    parts: int = 8
    """Parts of the source's data, of which the grid takes those that are whole."""
    steps: int = 3000
    """Optimiser steps of a training on the source."""
    self_training: tuple[int, int] = (10, 10)
    """Rounds of self-training, and the epochs of each."""
    model: str = "dgcnn"
    """Network of the grid."""


FULL = Sizes()
TINY = Sizes(1, 1, 2, 128, 1, ("pointnet",), 1, 1, 4, (1, 1), "pointnet")


def machine(options: argparse.Namespace, save: Save) -> None:
    """What this machine is, as ``qs3 doctor`` tells it."""
    from qs3.evaluation import hardware, versions

    doctor = subprocess.run(
        [sys.executable, "-m", "qs3", "doctor"], capture_output=True, text=True, check=False
    )
    lines = [line.strip() for line in doctor.stdout.splitlines()]
    save(
        {
            "hardware": hardware(),
            "versions": versions(),
            "doctor": [line for line in lines if "_mono" in line or line.startswith("Training")],
        }
    )


def tests(options: argparse.Namespace, save: Save) -> None:
    """The tests marked ``gpu``."""
    report = options.out / "work" / "tests.xml"
    files = ["tests/models", "tests/adaptation"]
    command = ["-m", "pytest", "-q", "-m", "gpu", *files, f"--junitxml={report}"]
    done = subprocess.run([sys.executable, *command], cwd=HERE.parent, check=False)
    counts = dict.fromkeys(("tests", "skipped", "failures", "errors"), 0)
    faults = []
    for suite in ElementTree.parse(report).getroot().iter("testsuite"):  # noqa: S314
        counts = {name: count + int(suite.get(name, 0)) for name, count in counts.items()}
        for case in suite.iter("testcase"):
            for fault in [*case.iter("failure"), *case.iter("error")]:
                faults.append(f"{case.get('name')}: {fault.get('message', '')[:300]}")
    save({"exit": done.returncode, **counts, "faults": faults})
    if done.returncode:
        raise SystemExit(f"{len(faults)} tests failed")


def scan(options: argparse.Namespace, save: Save) -> None:
    """Objects a second by each sensor, equality with the CPU, share of the bare ray rate."""
    from qs3.sensor.render.mitsuba import usable

    result: dict[str, Any] = {"scans": {}, "equality": {}, "rays": {}}
    cpu = "llvm_ad_mono" if usable("llvm_ad_mono") else "scalar_rgb"
    variants = [cpu, "scalar_rgb"] if options.cpu else ["cuda_ad_mono", cpu]
    for sensor in SENSORS:
        clouds = {}
        for variant in dict.fromkeys(variants):
            path = options.out / "work" / f"scan-{sensor}-{variant}.npz"
            again("--scan-with", sensor, variant, str(path), options=options)
            with np.load(path) as file:
                clouds[variant] = [file[f"points_{i}"] for i in range(len(file["seconds"]))]
                seconds = file["seconds"][1:]
            rate = float(len(seconds) / seconds.sum())
            scans = {"objects": len(seconds), "objects a second": rate}
            result["scans"][f"{sensor}, {variant}"] = scans
            save(result)
        if len(clouds) == 2:
            compared = f"{sensor}, {' and '.join(clouds)}"
            result["equality"][compared] = differences(*clouds.values())
    for sensor in SENSORS:
        rates = options.out / "work" / f"rays-{sensor}.json"
        command = [str(HERE / "ray_rate.py"), "--sensor", sensor, "--json", str(rates)]
        command += ["--meshes", str(1 if options.tiny else 4), "--repeats", "3"]
        subprocess.run([sys.executable, *command, "--variant", variants[0]], check=True)
        figures = json.loads(rates.read_text(encoding="utf-8"))
        result["rays"] |= {f"{sensor}, {name}": row for name, row in figures.items()}
        save(result)


def differences(first: list[np.ndarray], second: list[np.ndarray]) -> dict[str, Any]:
    """How far apart two machines' clouds of the same scans are."""
    from scipy.spatial import KDTree

    same, apart = [], []
    for a, b in zip(first, second, strict=True):
        same.append(a.shape == b.shape and bool((a == b).all()))
        apart.append(float(np.median(KDTree(b).query(a)[0]) / np.ptp(b, axis=0).max()))
    return {"same bits": f"{sum(same)} of {len(same)}", "median distance over size": max(apart)}


def scan_with(sensor: str, variant: str, path: str, sizes: Sizes) -> None:
    """Scan shapes with a renderer, and keep clouds and seconds."""
    import qs3
    from qs3 import shapes
    from qs3.sensor.render.mitsuba import MitsubaRenderer

    renderer = MitsubaRenderer(variant=variant)
    seconds, clouds = [], {}
    for index in range(sizes.objects + 1):
        mesh = shapes.make(shapes.CLASSES[index % len(shapes.CLASSES)], seed=index)
        start = time.perf_counter()
        settings = {"sensor": sensor, "views": sizes.views, "seed": index, "renderer": renderer}
        clouds[f"points_{index}"] = qs3.scan(mesh, **settings).points
        seconds.append(time.perf_counter() - start)
    np.savez(path, seconds=np.array(seconds), **clouds)


def matching(options: argparse.Namespace, save: Save) -> None:
    """Seconds of each matcher for a pair as the paper's sensor takes it; ad-census on both."""
    from matching import dots, grey

    from qs3.sensor.matching import MatchingSettings, match
    from qs3.sensor.matching.settings import Method

    shape = (120, 320) if options.tiny else (520, 760)
    disparities = 64 if options.tiny else 160
    left, right = (
        grey(image, 3.0, np.random.default_rng(0)) for image in dots(shape, 20.3, 0.025, 0.8, 1)
    )
    result: dict[str, Any] = {"pairs": {}}
    found = {}
    jobs: list[tuple[Method, str]] = [(method, "cpu") for method in get_args(Method)]
    if not options.cpu:
        jobs.append(("ad-census", "cuda"))
    for method, device in jobs:
        settings = MatchingSettings(method, disparities, block_size=15)
        seconds = []
        for _ in range(options.sizes.rounds + 1):  # the first warms up
            start = time.perf_counter()
            found[method, device] = match(left, right, settings, device)
            seconds.append(time.perf_counter() - start)
        result["pairs"][f"{method}, {device}"] = {"seconds": statistics.median(seconds[1:])}
        save(result)
    if not options.cpu:
        both = found["ad-census", "cpu"], found["ad-census", "cuda"]
        result["same bits on CUDA"] = bool(np.array_equal(*both, equal_nan=True))
        save(result)


def networks(options: argparse.Namespace, save: Save) -> None:
    """A training step of each network beside its textbook form: fp32, bf16, compiled; memory."""
    import models
    import torch

    sizes = options.sizes
    listed = [name for name in models.list_models() if models.reference_file(name).is_file()]
    result = read_result(options.out, "networks")
    rows = result.setdefault("rows", {})
    points, labels = models.clouds(sizes.batch, sizes.points, options.device)
    kinds = (("fp32", False), ("bf16", False), ("fp32", True), ("bf16", True))
    cases = itertools.product(kinds, sizes.networks or listed, models.FORMS)
    for (precision, compiled), network, form in cases:
        key = f"{network}, {form}, {precision}{', compiled' * compiled}"
        if key in rows:
            continue
        try:
            model = models.make(network, form, options.device)
            if compiled:  # without a GPU only the path is tried: building for a CPU takes minutes
                model.compile(backend="aot_eager" if options.cpu else "inductor")
            step = models.runner(model, "step", points, labels, precision)
            start = time.perf_counter()
            step()
            rows[key] = {"first, s": time.perf_counter() - start}
            seconds = models.race({"step": step}, sizes.rounds, 10.0)["step"]
            rows[key]["ms"] = 1e3 * statistics.median(seconds)
            if options.device == "cuda":
                before = torch.cuda.memory_allocated()
                torch.cuda.reset_peak_memory_stats()
                step()
                rows[key]["MiB"] = (torch.cuda.max_memory_allocated() - before) / 2**20
        except Exception as error:  # one network does not stop the others
            rows[key] = {"fault": f"{type(error).__name__}: {str(error)[:300]}"}
        save(result)


def data(options: argparse.Namespace, save: Save) -> None:
    """The source of the grid: scans, clean twins and surfaces of shapes, part by part."""
    from qs3.meshes import collect
    from qs3.sensor.render.mitsuba import MitsubaRenderer
    from qs3.sensor.scene import SceneSettings
    from qs3.store.generate import GenerateSettings, generate

    sizes = options.sizes
    renderer = MitsubaRenderer(variant="" if options.cpu else "cuda_ad_mono")
    room = {"sensor": "d435", "scene": SceneSettings("floor+behind"), "views": 1}
    jobs = {f"source-{part}": {"seed": part, "views": sizes.views} for part in range(sizes.parts)}
    if real_scans() is None:
        jobs = {"target": room | {"seed": 1000}, **jobs}
    result: dict[str, Any] = {"parts": {}}
    for name, own in jobs.items():
        start = time.perf_counter()
        items = collect("shapes", per_class=sizes.per_part, seed=own["seed"])
        settings = GenerateSettings(num_points=1024, renderer=renderer, **own)
        report = generate(items, options.out / "work" / name, settings, timeout=300.0)
        seconds = time.perf_counter() - start
        result["parts"][name] = asdict(report) | {"seconds": seconds}
        save(result)


def real_scans() -> Path | None:
    """Return the file of NYU's objects, where it is at hand."""
    path = Path(os.environ.get("QS3_SHARED_DATA", "")) / "nyuv2_objects.npz"
    return path if path.is_file() else None


def targets(options: argparse.Namespace) -> tuple[str, Any, Any]:
    """Return the target's name, its clouds to adapt to without labels, and those to score on.

    Of NYU's strict objects the first 70 % of the frames, in order, are adapted to. What is
    simulated where there are none is cut likewise, by objects.
    """
    from qs3.io import load_clouds

    points = options.sizes.points // 2
    path = real_scans()
    if path is None:
        clouds = load_clouds(options.out / "work" / "target", num_points=points)
        order, kept = np.arange(len(clouds)) % 10, np.ones(len(clouds), dtype=bool)
    else:
        clouds = load_clouds(path, num_points=points)
        with np.load(path) as file:
            order, kept = np.unique(file["frame"], return_inverse=True)[1], file["strict"] > 0
    first = order < 0.7 * (order.max() + 1)
    name = "simulated d435" if path is None else "NYU strict"
    train, test = clouds.select(kept & first), clouds.select(kept & ~first)
    if options.tiny:
        train, test = train.select(np.arange(20)), test.select(np.arange(3))
    return name, train.without_labels(), test


def sources(options: argparse.Namespace) -> dict[str, Any]:
    """Return the labelled clouds of each source: M, S, C, and all three."""
    from qs3.io import load_clouds
    from qs3.io.clouds import CloudKind, PointClouds
    from qs3.store.manifest import MANIFEST

    folders = [options.out / "work" / f"source-{part}" for part in range(options.sizes.parts)]
    folders = [folder for folder in folders if (folder / MANIFEST).is_file()]
    if not folders:
        raise SystemExit("no part of the source is whole; run the stage data first")
    kinds: dict[str, CloudKind] = {"M": "surface", "S": "points", "C": "clean"}

    def joined(names: str) -> PointClouds:
        parts = [
            load_clouds(folder, cloud=kinds[name], num_points=options.sizes.points // 2)
            for name in names
            for folder in folders
        ]
        points, labels = (
            np.concatenate([getattr(part, field) for part in parts])
            for field in ("points", "labels")
        )
        ids = tuple(f"{number:06d}" for number in range(len(points)))
        return PointClouds(points, labels, parts[0].class_names, ids)

    return {"M": joined("M"), "S": joined("S"), "S+C+M": joined("SCM"), "C": joined("C")}


def grid(options: argparse.Namespace, save: Save) -> None:
    """Real scans without labels: M, S, C, S+C+M, and S+C+M with QBST and SPST; seed by seed."""
    from qs3.evaluation.records import write_record
    from qs3.training import PRESETS, TrainSettings, evaluate, fit
    from qs3.training.progress import Deadline

    sizes, end = options.sizes, time.monotonic() + options.seconds
    name, target, test = targets(options)
    clouds = sources(options)
    result = read_result(options.out, "grid") | {"target": name, "adapted_to": len(target)}
    result |= {"scored_on": len(test), "source_per_kind": len(clouds["M"])}
    cells = [(source, "source-only") for source in ("S", "M", "S+C+M")]
    cells += [("S+C+M", "qbst"), ("S+C+M", "spst"), ("C", "source-only")]
    runs = result.setdefault("runs", {})
    for seed, (source, method) in itertools.product(range(1 if options.tiny else 3), cells):
        key = f"{source}, {method}, seed {seed}"
        if key in runs:
            continue
        batches = -(-len(clouds[source]) // sizes.batch)
        settings = TrainSettings(
            model=sizes.model,
            num_points=sizes.points // 2,
            epochs=-(-sizes.steps // batches),
            batch_size=sizes.batch,
            validate_every=0,
            seed=seed,
            accelerator="cpu" if options.cpu else "cuda",
        )
        folder = options.out / "work" / "runs"
        rounds, warm_up = None, None
        if method != "source-only":
            preset = PRESETS["spst" if method == "spst" else "default"]
            count, epochs = sizes.self_training
            rounds = replace(preset, rounds=count, epochs=epochs)
            if options.tiny:
                rounds = replace(rounds, threshold=0.0)
            warm_up = folder / f"{source}_source-only_seed-{seed}"
        run = folder / f"{source}_{method}_seed-{seed}"
        start = time.monotonic()
        fitted = fit(
            method,
            clouds[source],
            target if rounds else None,
            settings,
            rounds,
            run_dir=run,
            warm_up=warm_up,
            deadline=Deadline(end - start),
        )
        place = {"source": source, "target": name, "row": method, "seed": seed}
        record = evaluate(run, test, experiment=place)
        write_record(options.out / "results" / f"{run.name}.json", record)
        runs[key] = {
            "accuracy": record.scores.accuracy,
            "class_mean_accuracy": record.scores.class_mean_accuracy,
            "interval": list(record.scores.interval),
            "fitted": fitted.history[-1].accuracy if fitted.history else None,
            "rounds_trained": sum(not done.skipped for done in fitted.rounds),
            "seconds": time.monotonic() - start,
        }
        save(result)


STAGES: dict[str, tuple[Callable[[argparse.Namespace, Save], None], float]] = {
    "machine": (machine, 1),
    "tests": (tests, 4),
    "scan": (scan, 4),
    "matching": (matching, 1),
    "networks": (networks, 5),
    "data": (data, 4),
    "grid": (grid, 25),
}
"""What is done, in this order, and the minutes of 25 that each may take; the last has the rest."""


def again(*words: str, options: argparse.Namespace) -> None:
    """Run a part of this script in a process of its own."""
    flags = [flag for flag in ("cpu", "tiny") if getattr(options, flag)]
    command = [sys.executable, __file__, "--out", str(options.out), *(f"--{f}" for f in flags)]
    subprocess.run([*command, *words], check=True)


def read_stage(out: Path, name: str) -> dict[str, Any]:
    """Return what a stage has written; empty where it has nothing yet."""
    path = out / f"{name}.json"
    return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}


def read_result(out: Path, name: str) -> dict[str, Any]:
    """Return what a stage that was cut off has measured."""
    return read_stage(out, name).get("result", {})


def write_stage(out: Path, name: str, **fields: Any) -> None:
    """Add to what a stage has written."""
    from qs3.files import write_json

    write_json(out / f"{name}.json", read_stage(out, name) | {"stage": name} | fields)


def command_of(name: str, seconds: float, options: argparse.Namespace) -> list[str]:
    """Return the words behind ``python`` that run a stage."""
    flags = [f"--{flag}" for flag in ("cpu", "tiny") if getattr(options, flag)]
    words = [str(HERE / "gpu.py"), "--stage", name, "--seconds", f"{seconds:.0f}"]
    return [*words, "--out", str(options.out), *flags]


def run_stage(name: str, seconds: float, options: argparse.Namespace) -> str:
    """Run a stage within its time, keep how it ended, and return that."""
    log = options.out / "work" / f"{name}.log"
    start = time.monotonic()
    write_stage(options.out, name, status="unfinished", fault=None)
    with log.open("ab") as handle:
        process = subprocess.Popen(
            [sys.executable, *command_of(name, seconds, options)],
            stdout=handle,
            stderr=subprocess.STDOUT,
            start_new_session=True,
        )
        try:
            code = process.wait(seconds + GRACE)
            status = "done" if code == 0 else "failed"
        except subprocess.TimeoutExpired:
            status = "out of time"
        finally:
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGKILL)
                process.wait()
    last = log.read_text(encoding="utf-8", errors="replace").strip().splitlines()[-1:]
    if "TimeUpError" in " ".join(last):
        status = "out of time"
    fault = None if status == "done" else " ".join(last)[:300]
    spent = round(time.monotonic() - start, 1)
    write_stage(options.out, name, status=status, seconds=spent, fault=fault)
    return status


def shown(value: Any) -> str:
    """Return a value of a stage's result as text."""
    if isinstance(value, list):
        return ", ".join(map(shown, value))
    if isinstance(value, dict):
        return "; ".join(f"{key} {shown(inner)}" for key, inner in value.items())
    return f"{value:.4g}" if isinstance(value, float) else str(value)


def summary(out: Path) -> str:
    """Return what all stages have written as Markdown."""
    stages = {name: read_stage(out, name) for name in STAGES}
    text = ["# On a GPU", "", "| stage | what | ended | seconds |", "|---|---|---|---|"]
    for name, stage in stages.items():
        ended = " ".join(filter(None, [stage.get("status", "not begun"), stage.get("fault")]))
        seconds = stage.get("seconds", "")
        text.append(f"| {name} | {STAGES[name][0].__doc__} | {ended} | {seconds} |")
    for name, stage in stages.items():
        text += ["", f"## {name}", ""]
        for key, rows in stage.get("result", {}).items():
            if not (isinstance(rows, dict) and all(isinstance(r, dict) for r in rows.values())):
                text.append(f"- {key}: {shown(rows)}")
                continue
            head = list(dict.fromkeys(column for row in rows.values() for column in row))
            text += ["", f"| {key} | {' | '.join(head)} |", "|---" * (len(head) + 1) + "|"]
            for title, row in rows.items():
                cells = [shown(row.get(column, "")) for column in head]
                text.append(f"| {title} | {' | '.join(cells)} |")
    return "\n".join([*text, ""])


def parse(words: list[str] | None = None) -> argparse.Namespace:
    """Read the command line."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("--out", type=Path, default=HERE.parent / "results" / "gpu")
    parser.add_argument("--minutes", type=float, default=25, help="for everything")
    parser.add_argument("--only", nargs="+", default=list(STAGES), choices=STAGES)
    parser.add_argument("--cpu", action="store_true", help="without a GPU")
    parser.add_argument("--tiny", action="store_true", help="at toy size, to try it out")
    parser.add_argument("--dry-run", action="store_true", help="tell stages and commands alone")
    parser.add_argument("--stage", choices=STAGES, help=argparse.SUPPRESS)
    parser.add_argument("--seconds", type=float, help=argparse.SUPPRESS)
    parser.add_argument("--scan-with", nargs=3, help=argparse.SUPPRESS)
    options = parser.parse_args(words)
    options.sizes = TINY if options.tiny else FULL
    options.device = "cpu" if options.cpu else "cuda"
    return options


def main() -> int:
    """Run the stages that are not done, and tell how each ended."""
    options = parse()
    if options.scan_with:
        sensor, variant, path = options.scan_with
        scan_with(sensor, variant, path, options.sizes)
        return 0
    if options.stage:
        STAGES[options.stage][0](
            options, lambda result: write_stage(options.out, options.stage, result=result)
        )
        return 0
    end = time.monotonic() + 60 * options.minutes
    if options.dry_run:
        for name in options.only:
            words = command_of(name, 60 * STAGES[name][1], options)
            print(f"{name}: {STAGES[name][0].__doc__}\n    python {shlex.join(words)}")
        return 0
    if not options.cpu:
        import torch

        if not torch.cuda.is_available():
            raise SystemExit("torch sees no CUDA device; --cpu --tiny tries every stage without")
    signal.signal(signal.SIGTERM, lambda *_: sys.exit(143))  # ends the stage too
    (options.out / "work").mkdir(parents=True, exist_ok=True)
    (options.out / "work" / ".gitignore").write_text("*\n", encoding="utf-8")
    for name in options.only:
        if read_stage(options.out, name).get("status") == "done":
            print(f"{name}: is done", flush=True)
            continue
        left = end - time.monotonic() - 20
        if left < 10:
            print(f"{name}: no time is left; run the same command again", flush=True)
            continue
        own = 60 * STAGES[name][1] * options.minutes / 25
        status = run_stage(name, min(own, left), options)
        print(f"{name}: {status}, log in work/{name}.log", flush=True)
        (options.out / SUMMARY).write_text(summary(options.out), encoding="utf-8")
    print(options.out / SUMMARY)
    return int(any(read_stage(options.out, name).get("status") != "done" for name in options.only))


if __name__ == "__main__":
    raise SystemExit(main())
