"""Seconds from a folder of CAD to answers, and of single answers, in one run.

Run: python benchmarks/parts_times.py

Twenty built-in parts, ten scans each; wall and CPU seconds, of repeated commands the median of
five.
"""

import resource
import subprocess
import sys
import tempfile
import time
from pathlib import Path

import numpy as np

from qs3 import shapes
from qs3.files import write_bytes


def run(*words: object) -> tuple[float, float]:
    """Run a command of qs3; return its wall and CPU seconds."""
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    command = [sys.executable, "-m", "qs3", *map(str, words)]
    subprocess.run(command, check=True, capture_output=True)
    wall, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
    return wall, after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        rows = measure(Path(folder))
    print("| command | wall s | CPU s |", "|---|---|---|", sep="\n")
    for name, (wall, cpu) in rows.items():
        print(f"| {name} | {wall:.2f} | {cpu:.2f} |")


def measure(out: Path) -> dict[str, tuple[float, float]]:
    """Return the wall and CPU seconds of each command."""
    for i in range(20):
        name = shapes.PARTS[i % len(shapes.PARTS)]
        part = shapes.make(name, seed=i).apply_scale(1000)
        write_bytes(out / "cad" / f"{name}-{i}.stl", bytes(part.export(file_type="stl")))
    cad, source, scans, forest = (out / n for n in ("cad", "source", "scans", "run"))
    mine, last = ("--meshes", cad, "--units", "mm"), ("--out", forest)
    generate = ("generate", "--recipe", "parts", *mine)
    train = ("train", "--model", "forest", "--source", source, "--source-cloud", "all")
    rows = {"qs3 generate, 200 scans": run(*generate, "--out", source)}
    rows["qs3 train, with CAD"] = run(*train, *mine, *last)
    run(*generate, "--scans-per-mesh", 1, "--seed", 1, "--out", out / "other")
    run("convert", out / "other", scans, "--to", "ply")
    one = next(scans.rglob("*.ply"))
    kept = out / "kept.safetensors"
    rows["qs3 locate, 20 CAD files, one scan"] = run("locate", cad, one, "--units", "mm")
    run("locate", cad, one, "--units", "mm", "--library", kept)
    rows["qs3 locate, kept library, 20 scans"] = run("locate", kept, scans)
    rows["qs3 predict, 20 scans"] = run("predict", forest, scans)
    rows["qs3 predict --no-pose, 20 scans"] = run("predict", forest, scans, "--no-pose")
    named: dict[object, str] = {forest: "run", one: "scan", kept: "kept library"}
    predict = ("predict", forest, one)
    for words in (("--version",), ("locate", kept, one), predict, (*predict, "--no-pose")):
        label = " ".join(named.get(word, str(word)) for word in words)
        wall, cpu = np.median([run(*words) for _ in range(5)], axis=0)
        rows[f"qs3 {label}"] = float(wall), float(cpu)
    return rows


if __name__ == "__main__":
    main()
