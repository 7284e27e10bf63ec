"""Hand-made hostile inputs: one of each fault that an attack on the package has ever shown."""

import contextlib
import io
import json
import os
import pickle
import resource
import shutil
import signal
import struct
import subprocess
import sys
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from qs3.io.clouds import RaggedClouds

from ..meshes.test_announced import TRIANGLE, glb, tree
from .layouts import build_generated, build_run, clouds


@dataclass(frozen=True)
class Case:
    """One hostile input."""

    act: Callable[[Path], Any]
    """Make it in an empty folder and hand it to the command or reader."""
    ends: tuple[str, ...]
    """How it may end."""
    slow: bool = False


CASES: dict[str, Case] = {}


def case(*ends: str, slow: bool = False, **values: Any) -> Callable[[Callable], Callable]:
    """Register a function of a folder, once for each of the values of its argument."""

    def register(act: Callable) -> Callable:
        name = act.__name__.replace("_", "-")
        if not values:
            CASES[name] = Case(act, ends, slow)
        for key, choices in values.items():
            for word, value in choices.items():
                CASES[f"{name}-{word}"] = Case(_with(act, key, value), ends, slow)
        return act

    return register


def _with(act: Callable, key: str, value: Any) -> Callable[[Path], Any]:
    return lambda folder: act(folder, **{key: value})


def command(*words: Any) -> str:
    """Run ``qs3``; its one line of refusal is raised, anything else than that is a fault."""
    from qs3.cli import main
    from qs3.errors import QS3Error

    streams = io.StringIO(), io.StringIO()
    code: Any = 0
    with contextlib.redirect_stdout(streams[0]), contextlib.redirect_stderr(streams[1]):
        try:
            main([str(word) for word in words])
        except SystemExit as error:
            code = error.code or 0
    printed = "".join(stream.getvalue() for stream in streams)
    printed.encode()  # no lone surrogate
    control = {c for c in printed if (ord(c) < 32 and c not in "\n\r\t") or c in "\x7f\x9b"}
    if control:
        raise AssertionError(f"control characters {control} reach the terminal")
    faults = [line for line in streams[1].getvalue().splitlines() if line.startswith("qs3: ")]
    if code in (1, 2) and faults:  # 1: something was left out
        raise QS3Error("\n".join(faults))
    if code:
        raise AssertionError(f"exit code {code}: {printed}")
    return printed


def _run(folder: Path) -> Path:
    """A run, trained once for all cases, and its data beside it."""
    made = folder.parent / "own" / "made-run"
    if not made.exists():
        with contextlib.redirect_stderr(io.StringIO()):
            build_run(made)
    return Path(shutil.copytree(made, folder / "run"))


def _npy(folder: Path, given: RaggedClouds | None = None) -> Path:
    """A valid data set of the smallest layout."""
    from qs3.io.layouts import FORMATS

    FORMATS["npy"].write(folder / "src", given or clouds())
    return folder / "src"


_TOO_MUCH = {"deep": "[" * 100_000, "long": "9" * 5000}


@case("refused", text=_TOO_MUCH)
def manifest_json(folder: Path, text: str) -> None:
    from qs3.store.manifest import MANIFEST

    build_generated(folder / "data")
    (folder / "data" / MANIFEST).write_text(f'{{"schema": {text}')
    command("info", folder / "data")


@case("refused", text=_TOO_MUCH)
def record_json(folder: Path, text: str) -> None:
    from qs3.evaluation.records import read_record

    (folder / "record.json").write_text(f'{{"schema": {text}}}')
    read_record(folder / "record.json")


@case("refused", text=_TOO_MUCH)
def run_weights_json(folder: Path, text: str) -> None:
    import safetensors.numpy

    from qs3.training.checkpoint import load_model

    path = folder / "model.safetensors"
    path.write_bytes(safetensors.numpy.save({"a": np.zeros(1)}, {"qs3": f'{{"format": {text}}}'}))
    load_model(path)


@case("refused", text=_TOO_MUCH)
def sensor_toml(folder: Path, text: str) -> None:
    (folder / "camera.toml").write_text(f"width = {text}\n")
    command("sensors", "show", folder / "camera.toml")


_NO_NUMBERS = {"fraction": 1.5, "text": "x", "true": True, "list": [1], "huge": 1e12, "many": 10**7}


@case("refused", value=_NO_NUMBERS)
def run_num_points(folder: Path, value: Any) -> None:
    """In a run's settings."""
    run = _run(folder)
    settings = json.loads((run / "settings.json").read_text())
    settings["train"]["num_points"] = value
    (run / "settings.json").write_text(json.dumps(settings))
    command("evaluate", run, "--data", folder.parent / "own" / "made-run-data")


@case("ok", "refused")
def run_record_surrogate(folder: Path) -> None:
    run = _run(folder)
    (path,) = (run / "records").iterdir()
    value = json.loads(path.read_text())
    value["method"] = "\ud800"
    path.write_text(json.dumps(value))
    command("report", run, "--out", folder / "page.html")


@case("ok")
def ply_texture_comment(folder: Path) -> None:
    """Read without a word of the parser's own."""
    from qs3.meshes import load_mesh

    (folder / "a.ply").write_text(
        "ply\nformat ascii 1.0\ncomment TextureFile none.png\nelement vertex 3\n"
        "property float x\nproperty float y\nproperty float z\nelement face 1\n"
        "property list uchar int vertex_indices\nend_header\n0 0 0\n1 0 0\n0 1 0\n3 0 1 2\n"
    )
    load_mesh(folder / "a.ply")


@case("refused")
def npz_of_zeros(folder: Path) -> None:
    """3.9 GiB of zeros in 4 MiB; float32 would be twice that."""
    from qs3.io.load import load_clouds

    header = io.BytesIO()
    shape = (170_000, 4096, 3)
    np.lib.format.write_array_header_1_0(
        header, {"descr": "<f2", "fortran_order": False, "shape": shape}
    )
    block = 1 << 24
    blocks = int(np.prod(shape)) * 2 // block
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    packed = packer.compress(header.getvalue()) + packer.flush(zlib.Z_FULL_FLUSH)
    packed += (packer.compress(bytes(block)) + packer.flush(zlib.Z_FULL_FLUSH)) * blocks
    packed += packer.flush()
    size = len(header.getvalue()) + blocks * block
    name = b"points.npy"
    common = struct.pack("<5H3I2H", 20, 0, 8, 0, 33, 0, len(packed), size, len(name), 0)
    local = b"PK\3\4" + common + name
    entry = b"PK\1\2" + struct.pack("<H", 20) + common + struct.pack("<3H2I", 0, 0, 0, 0, 0) + name
    end = struct.pack("<4s4H2IH", b"PK\5\6", 0, 0, 1, 1, len(entry), len(local) + len(packed), 0)
    (folder / "a.npz").write_bytes(local + packed + entry + end)
    load_clouds(folder / "a.npz", num_points=32)


@case("refused", slow=True)
def parquet_of_large_rows(folder: Path) -> None:
    """A row of 600 MB that a dictionary makes small."""
    from qs3.io.load import load_clouds

    build_generated(folder / "data")
    path = min((folder / "data").glob("*.parquet"))
    # Arrow's writer ends the process where it gets no memory, and keeps what it had.
    code = f"from tests.fuzz.cases import write_large_row as w; w({str(path)!r})"
    subprocess.run([sys.executable, "-c", code], cwd=Path(__file__).parents[2], check=True)
    load_clouds(folder / "data", num_points=32)


def write_large_row(path: str) -> None:
    """Put a row of 600 MB into a shard, in as much memory as that takes."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    _, most = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (most, most))
    table = pq.read_table(path).slice(0, 1)
    points = pa.array(np.zeros(150_000_000, np.float32))
    row = pa.ListArray.from_arrays(pa.array([0, len(points)], pa.int32()), points)
    at = table.column_names.index("points")
    pq.write_table(table.set_column(at, table.field(at), row.cast(table.field(at).type)), path)


@case("refused")
def many_points_asked_for(folder: Path) -> None:
    command("train", "--source", _npy(folder), "--num-points", 10**7, "--out", folder / "run")


@case("refused")
def control_characters(folder: Path) -> None:
    command("scan", folder / "a\x1b[2J\x9b31m.off", "--out", folder / "out")


@case("refused")
def empty_name_to_write_to(folder: Path) -> None:
    from qs3.errors import QS3Error

    build_generated(folder / "data")
    try:
        command("merge", folder / "data", "--out", "")
    except QS3Error as error:
        assert "--out" in str(error), error
        raise


@case("ok", words={"ascii": "exec", "closed": "exec 2>&-;"})
def streams(folder: Path, words: str) -> None:
    """Output of letters beyond ASCII where the terminal has none, or where one stream is shut."""
    own = {"LC_ALL": "C", "PYTHONUTF8": "0", "PYTHONCOERCECLOCALE": "0"}
    script = f'{words} "$0" -m qs3 sensors'
    done = subprocess.run(
        ["sh", "-c", script, sys.executable],
        env=os.environ | own, cwd=folder, capture_output=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr.decode(errors="replace")[-200:]
    assert b"d435" in done.stdout


_ANNOUNCED = {
    "corners": (tree(count=500_000_000), TRIANGLE),
    "instances": (tree(nodes=20_000, vertices=3000), bytes(3000 * 12)),
}


@case("refused", scene=_ANNOUNCED)
def glb_that_announces(folder: Path, scene: tuple[dict, bytes]) -> None:
    command("scan", glb(folder / "a.glb", *scene), "--out", folder / "out")


@case("refused")
def archive_of_many_members(folder: Path) -> None:
    with zipfile.ZipFile(folder / "a.npz", "w") as archive:
        for index in range(100_000):
            archive.writestr(f"{index}.npy", b"")
    command("info", folder / "a.npz")


@case("ok")
def planted_link(folder: Path) -> None:
    theirs = folder.parent / "own" / "theirs"
    theirs.mkdir(parents=True, exist_ok=True)
    (theirs / "a.txt").write_text("keep")
    source = _npy(folder)
    for name in (".out.unfinished", ".out.0123abcd.tmp"):
        (folder / name).symlink_to(theirs)
    command("convert", source, folder / "out", "--to", "ply")
    assert [path.name for path in theirs.iterdir()] == ["a.txt"]


@case("ok", name={"long": "x" * 250, "bytes": os.fsdecode(b"\xff\xfe")})
def folder_name(folder: Path, name: str) -> None:
    target = folder / name
    command("convert", _npy(folder), target, "--to", "ply")
    command("info", target)


@case("refused")
def two_trainings(folder: Path) -> None:
    from qs3.files import folder_lock

    (folder / "run").mkdir()
    with folder_lock(folder / "run"):
        command("train", "--source", _npy(folder), "--num-points", 16, "--out", folder / "run")


@case("refused", verb={"info": ["info"], "train": ["train", "--num-points", "16", "--source"]})
def store_that_is_away(folder: Path, verb: list[str]) -> None:
    from qs3.errors import QS3Error

    out = ["--out", folder / "run"] if verb[0] == "train" else []
    try:
        command(*verb, "nowhere://bucket/clouds", *out)
    except QS3Error as error:
        assert "not a qs3 data set" not in str(error), error
        raise


@case("refused")
def full_disk(folder: Path) -> None:
    """The largest file that may be written has 300 bytes, as on a disk that is nearly full."""
    from qs3.errors import QS3Error

    before = (
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN),
        resource.getrlimit(resource.RLIMIT_FSIZE),
    )
    source = _npy(folder)
    try:
        resource.setrlimit(resource.RLIMIT_FSIZE, (300, before[1][1]))
        command("convert", source, folder / "out", "--to", "ply")
    except QS3Error as error:
        assert str(folder / "out") in str(error), error
        raise
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before[1])
        signal.signal(signal.SIGXFSZ, before[0])
        left = [path.name for path in folder.iterdir() if path.name != "src"]
        assert left in ([], [".printed"]), left


@case("ok")
def clouds_moved_by_a_hair(folder: Path) -> None:
    """Test clouds that are those of the training, but for 1e-4: their record is marked."""
    from qs3.io.load import read_clouds
    from qs3.training import evaluate

    run, seen = _run(folder), read_clouds(folder.parent / "own" / "made-run-data")[0]
    moved = _npy(folder, replace(seen, clouds=[cloud + 1e-4 for cloud in seen.clouds]))
    assert "training clouds" in evaluate(run, moved, split="train").marks


# That the attack sees what it is there to see: each of these is found out.


@case("wrote outside")
def caught_writing(folder: Path) -> None:
    (folder.parent / "elsewhere").touch()


@case("wrote outside")
def caught_removing(folder: Path) -> None:
    shutil.rmtree(shutil.copytree(folder, folder.parent / "elsewhere-too"))


@case("unpickled")
def caught_unpickling(folder: Path) -> None:
    pickle.loads(pickle.dumps(Path))  # noqa: S301


@case("printed")
def caught_printing(folder: Path) -> None:
    os.write(2, b"libpng warning")


@case("traceback")
def caught_raising(folder: Path) -> None:
    raise KeyError(folder)


@case("over memory")
def caught_taking_memory(folder: Path) -> None:
    bytearray(2**40)


@case("died")
def caught_dying(folder: Path) -> None:
    os._exit(3)
