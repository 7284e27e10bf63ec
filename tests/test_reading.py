import bz2
import json
import mmap
import os
import re
import resource
import subprocess
import sys
import threading
import zipfile
import zlib
from collections.abc import Callable
from functools import partial
from pathlib import Path

import h5py
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from qs3 import reading as limits
from qs3.clouds.files import read_cloud
from qs3.clouds.load import load_clouds
from qs3.errors import InputError, StorageError
from qs3.frames.images import read_depth
from qs3.meshes.labels_csv import read_labels
from qs3.reading import check_size, reading, unpack
from qs3.store.shards import load_shard

from .clouds.hostile import png_bytes
from .stores import write_store

pytestmark = pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="Linux only")


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "a.ply"
    path.write_bytes(b"ply")
    return path


def test_missing_empty_folder_and_pipe_are_refused(tmp_path: Path) -> None:
    (tmp_path / "empty").touch()
    os.mkfifo(tmp_path / "pipe")
    for name, fault in {
        "absent": "no such file",
        "empty": "the file is empty",
        "": "is a folder",
        "pipe": "is not a regular file",
    }.items():
        with (
            pytest.raises(InputError, match=f"{tmp_path / name}: {fault}"),
            reading(tmp_path / name),
        ):
            pytest.fail("was read")


def test_sparse_file_above_the_ceiling_is_refused_unless_streamed(file: Path) -> None:
    os.truncate(file, 100 << 30)
    with pytest.raises(InputError, match="more than the limit"), reading(file):
        pytest.fail("was read")
    with reading(file, streamed=True):
        check_size("a part", 8 << 30)
        with pytest.raises(InputError, match="a part has"):
            check_size("a part", (8 << 30) + 1)


def test_any_exception_becomes_one_line_with_the_name(file: Path) -> None:
    with pytest.raises(InputError) as caught, reading(file):
        raise KeyError("first\nsecond")
    message = (
        "cannot be read as PLY ('first\\nsecond' is missing or unknown); mend or export it again"
    )
    assert str(caught.value) == f"{file}: {message}"
    with pytest.raises(InputError, match=r"a\.ply: takes more memory"), reading(file):
        raise MemoryError


def test_own_errors_keep_their_type_and_get_the_name_once(file: Path) -> None:
    for message in ("disk full", f"{file}: disk full"):
        with pytest.raises(StorageError) as caught, reading(file):
            raise StorageError(message)
        assert str(caught.value) == f"{file}: disk full"
    with pytest.raises(KeyboardInterrupt), reading(file):
        raise KeyboardInterrupt


def test_the_limit_of_a_block_goes_by_its_file_and_thread(file: Path, tmp_path: Path) -> None:
    large = tmp_path / "large.ply"
    large.touch()
    os.truncate(large, 64 << 20)
    with reading(file):
        check_size("a", (2 << 30) + 96)
        with pytest.raises(InputError, match="a has"):
            check_size("a", (2 << 30) + 97)
        with reading(large):
            check_size("a", 4 << 30)
        with pytest.raises(InputError, match="a has"), reading(large):
            check_size("a", (4 << 30) + 1)
        thread = threading.Thread(target=check_size, args=("b", 8 << 30))
        thread.start()
        thread.join()
        with pytest.raises(InputError, match="a has"):
            check_size("a", 4 << 30)
    check_size("a", 8 << 30)


def test_no_limit_of_the_process_changes_while_a_file_is_read(file: Path) -> None:
    """Another thread takes more memory than the reader of so small a file may."""
    kinds = ("RLIMIT_AS", "RLIMIT_DATA", "RLIMIT_RSS")
    before = [resource.getrlimit(getattr(resource, kind)) for kind in kinds]
    taken: list[int] = []

    def take() -> None:
        with mmap.mmap(-1, 6 << 30) as memory:
            taken.append(len(memory))

    with reading(file):
        assert [resource.getrlimit(getattr(resource, kind)) for kind in kinds] == before
        thread = threading.Thread(target=take)
        thread.start()
        thread.join()
    assert taken == [6 << 30]


@pytest.mark.parametrize("kind", ["bz2", "lz4", "zstd"])
def test_packed_streams_unpack_up_to_the_limit_and_no_further(
    kind: str, file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    lz4, zstd = pytest.importorskip("lz4.frame"), pytest.importorskip("backports.zstd")
    ways = {
        "bz2": (bz2.compress, bz2.BZ2Decompressor),
        "lz4": (lz4.compress, lz4.LZ4FrameDecompressor),
        "zstd": (zstd.compress, zstd.ZstdDecompressor),
    }
    pack, new = ways[kind]
    monkeypatch.setattr(limits, "_BASE", 1 << 20)
    text = bytes(range(256)) * 100
    with reading(file):
        assert unpack("it", new, pack(text)) == text
        assert unpack("it", new, pack(text) + pack(text)) == 2 * text
        assert len(unpack("it", new, pack(bytes(1 << 20)))) == 1 << 20
        for bomb in (pack(bytes(50 << 20)), pack(bytes(600_000)) * 2):
            with pytest.raises(InputError, match=r"it has \d+ bytes, more than the limit"):
                unpack("it", new, bomb)
        with pytest.raises(ValueError, match="it is cut off"):
            unpack("it", new, pack(text)[:-8])


def test_a_child_process_is_limited(file: Path) -> None:
    code = "import sys; from pathlib import Path; from qs3.reading import limit_memory; "
    code += "limit_memory(Path(sys.argv[1])); bytearray(1 << 28); print('ok'); bytearray(3 << 30)"
    done = subprocess.run([sys.executable, "-c", code, str(file)], capture_output=True, text=True)
    assert done.stdout == "ok\n"
    assert "MemoryError" in done.stderr


ONES = np.ones((2, 40, 3), np.float32)


def bomb_npz(path: Path) -> None:
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED, compresslevel=1) as archive:
        for name in ("points.npy", "other.npy"):
            with archive.open(name, "w", force_zip64=True) as member:
                member.write(bytes(120 << 20))


def huge_npy(path: Path) -> None:
    np.save(path, ONES[0])
    header = path.read_bytes().replace(b"(40, 3), }" + b" " * 10, b"(4" + b"0" * 11 + b", 3), }")
    path.write_bytes(header)


def large_h5(path: Path) -> None:
    with h5py.File(path, "w") as file:
        shape = (40_000, 2048, 3)
        file.create_dataset("data", shape, "f4", chunks=(1, 2048, 3), compression="gzip")
        file["label"] = np.zeros(len(file["data"]), np.int32)


def chunk_h5(path: Path) -> None:
    """A chunk that says 480 bytes, and unpacks to 240 MB."""
    packed = zlib.compress(bytes(240 << 20), 1)
    with h5py.File(path, "w") as file:
        data = file.create_dataset("data", (1, 40, 3), "f4", chunks=(1, 40, 3), compression="gzip")
        data.id.write_direct_chunk((0, 0, 0), packed)
        file["label"] = np.zeros(1, np.int32)


def nested_h5(path: Path) -> None:
    with h5py.File(path, "w") as file:
        plan = h5py.h5p.create(h5py.h5p.DATASET_CREATE)
        plan.set_chunk((1, 40, 3))
        plan.set_deflate(9)
        plan.set_deflate(9)
        space = h5py.h5s.create_simple((1, 40, 3))
        h5py.h5d.create(file.id, b"data", h5py.h5t.NATIVE_FLOAT, space, plan)
        file["label"] = np.zeros(1, np.int32)


def wide_csv(path: Path) -> None:
    path.write_text("file,class" + "," * 5_000 + "\n" + "\n" * 5_000)


def large_png(path: Path) -> None:
    path.write_bytes(png_bytes(20_000, 20_000))


BOMBS: dict[str, tuple[Callable[[Path], None], Callable[[Path], object], str]] = {
    "bomb.npz": (bomb_npz, read_cloud, "its content has"),
    "bombs.npz": (bomb_npz, partial(load_clouds, num_points=8), "its content has"),
    "huge.npy": (huge_npy, read_cloud, "cannot be read as NPY|more memory"),
    "ply_data_train0.h5": (large_h5, partial(load_clouds, num_points=8), "data has"),
    "ply_data_train1.h5": (chunk_h5, partial(load_clouds, num_points=8), "a chunk has"),
    "ply_data_train2.h5": (nested_h5, partial(load_clouds, num_points=8), "another filter"),
    "wide.csv": (wide_csv, lambda path: read_labels(path, path.parent, []), "its table has"),
    "large.png": (large_png, read_depth, "large.png: "),
}


def load_bombs(folder: Path) -> None:
    """Load each bomb with little memory, and write the errors and how much it took."""
    limits._BASE = 16 << 20
    rows = []
    for name, (_, load, _) in BOMBS.items():
        before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
        try:
            load(folder / name)
            error = "no error"
        except InputError as caught:
            error = str(caught)
        taken = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
        rows.append((name, error, taken))
    (folder / "loaded.json").write_text(json.dumps(rows))


@pytest.fixture(scope="module")
def loaded(tmp_path_factory: pytest.TempPathFactory) -> dict[str, tuple[str, int]]:
    """Error and KiB taken of each bomb, in a new process: a fork may wait for threads for ever."""
    folder = tmp_path_factory.mktemp("bombs")
    for name, (make, _, _) in BOMBS.items():
        make(folder / name)
    code = "import sys; from pathlib import Path; from tests.test_reading import load_bombs; "
    command = [sys.executable, "-c", f"{code}load_bombs(Path(sys.argv[1]))", str(folder)]
    root = Path(__file__).parents[1]
    done = subprocess.run(command, cwd=root, capture_output=True, text=True, timeout=100)
    assert done.returncode == 0, done.stderr
    rows = json.loads((folder / "loaded.json").read_text())
    return {name: (error, taken) for name, error, taken in rows}


@pytest.mark.parametrize("name", BOMBS)
def test_what_unpacks_to_much_is_refused_and_takes_no_memory(
    name: str, loaded: dict[str, tuple[str, int]]
) -> None:
    error, taken = loaded[name]
    assert re.search(BOMBS[name][2], error)
    assert len(error.splitlines()) == 1
    assert taken < 100 << 10, f"{taken} KiB"


def test_a_shard_of_runs_and_dictionaries_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(limits, "_BASE", 16 << 20)
    rows = [(0, "train", 8), (1, "test", 8)]
    folder = write_store(tmp_path / "set", ("bed", "chair"), rows)
    shard, table = folder / "shard-00000.parquet", load_shard(folder, 0)
    pq.write_table(table, shard, use_dictionary=True)
    with pytest.raises(InputError, match="its values are not stored plainly"):
        load_shard(folder, 0)
    place = table.column_names.index("points")
    points = pa.array([np.zeros(5_000_000, np.float32)], table["points"].type)
    many = table.slice(0, 1).set_column(place, table.field("points"), points)
    pq.write_table(many, shard, use_dictionary=False, compression="zstd")
    with pytest.raises(InputError, match="its content has"):
        load_shard(folder, 0)
