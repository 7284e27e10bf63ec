import os
import resource
import threading
from pathlib import Path

import pytest

from qs3 import reading as guard
from qs3.errors import InputError, StorageError
from qs3.io import reading

pytestmark = pytest.mark.skipif(not Path("/proc/self/statm").exists(), reason="Linux only")


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "a.ply"
    path.write_bytes(b"ply")
    return path


def limit() -> int:
    return resource.getrlimit(resource.RLIMIT_AS)[0]


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
    before = limit()
    with reading(file, streamed=True):
        assert 0 < limit() - 8 * 2**30 < 2**40
        with pytest.raises(MemoryError):
            bytearray(9 << 30)
    assert limit() == before


def test_any_exception_becomes_one_line_with_the_name(file: Path) -> None:
    with pytest.raises(InputError) as caught, reading(file):
        raise KeyError("first\nsecond")
    assert str(caught.value) == f"{file}: cannot be read as PLY ('first\\nsecond')"
    with pytest.raises(InputError, match=r"a\.ply: takes over 2.0 GiB"), reading(file):
        bytearray(3 << 30)


def test_own_errors_keep_their_type_and_get_the_name_once(file: Path) -> None:
    for message in ("disk full", f"{file}: disk full"):
        with pytest.raises(StorageError) as caught, reading(file):
            raise StorageError(message)
        assert str(caught.value) == f"{file}: disk full"
    with pytest.raises(KeyboardInterrupt), reading(file):
        raise KeyboardInterrupt


def test_limit_is_lifted_by_the_last_of_several_threads(file: Path) -> None:
    before, entered, leave = limit(), threading.Event(), threading.Event()

    def read() -> None:
        with reading(file):
            entered.set()
            leave.wait(10)

    thread = threading.Thread(target=read)
    with reading(file):
        thread.start()
        assert entered.wait(10)
        with reading(file):
            pass
    assert limit() != before
    leave.set()
    thread.join()
    assert limit() == before
    assert guard._readers == 0
