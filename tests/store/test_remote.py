"""Data sets at addresses that are no folder of this machine."""

import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from qs3.errors import InputError, MissingExtraError, StorageError
from qs3.io.layouts.store import read_ragged
from qs3.io.load import load_clouds
from qs3.store.folder import _file_system, open_folder
from qs3.store.generate import GenerateReport
from qs3.store.info import info
from qs3.store.merge import merge
from qs3.store.verify import verify


def items(fake):
    return fake.work(10, bad=(5,))


def whole(fake, folder: Path) -> dict[str, bytes]:
    fake.run(items(fake), folder, row=fake.flaky_row)
    return fake.content(folder)


def content(url: str) -> dict[str, bytes]:
    folder = open_folder(url)
    return {name: folder.read(name) for name in folder.names()}


@pytest.fixture
def memory() -> Iterator[str]:
    """An empty folder in fsspec's memory."""
    import fsspec

    yield "memory://shelf/set"
    fsspec.filesystem("memory").store.clear()


@pytest.fixture
def bucket(monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """A bucket of a server on this machine that speaks S3."""
    pytest.importorskip("s3fs", reason="needs the extra s3")
    moto = pytest.importorskip("moto.server", reason="needs moto[server]")
    server = moto.ThreadedMotoServer(port=0)
    server.start()
    host, port = server.get_host_and_port()
    for name, value in {
        "AWS_ACCESS_KEY_ID": "testing",
        "AWS_SECRET_ACCESS_KEY": "testing",
        "AWS_DEFAULT_REGION": "us-east-1",
        "AWS_ENDPOINT_URL": f"http://127.0.0.1:{port}",
    }.items():
        monkeypatch.setenv(name, value)
    assert host
    import s3fs

    s3fs.S3FileSystem.clear_instance_cache()
    s3fs.S3FileSystem().mkdir("scans")
    yield "s3://scans/set"
    server.stop()


def test_a_run_into_memory_is_stopped_resumed_and_equal(fake, tmp_path, memory):
    with pytest.raises(KeyboardInterrupt):
        fake.run(items(fake), memory, row=fake.Interrupting(5))
    assert any(name.startswith(".parts/") for name in content(memory))
    report = fake.run(items(fake), memory, row=fake.flaky_row)
    assert report == GenerateReport(done=4, skipped=5, failed=1)
    assert content(memory) == whole(fake, tmp_path / "whole")
    assert verify(memory, progress=False) == []
    assert info(memory)["rows"] == 9
    there = read_ragged(memory).clouds
    np.testing.assert_array_equal(there, read_ragged(tmp_path / "whole").clouds)
    np.testing.assert_array_equal(load_clouds(memory, num_points=None).points, there)


def test_a_folder_of_something_else_is_refused(fake, memory):
    open_folder(memory).write("thesis.txt", b"mine")
    with pytest.raises(InputError, match="holds something else"):
        fake.run(items(fake), memory)
    assert set(content(memory)) == {"thesis.txt"}


def test_processes_write_to_an_object_store_themselves(fake, tmp_path, bucket):
    for part in range(2):
        how = {"workers": 1, "shard": (part, 2)}
        fake.run(items(fake), f"{bucket}-{part}", row=fake.flaky_row, **how)
    merge([f"{bucket}-0", f"{bucket}-1"], bucket, progress=False)
    wanted = whole(fake, tmp_path / "whole")
    assert content(bucket) == wanted
    merge([f"{bucket}-0", f"{bucket}-1"], tmp_path / "merged", progress=False)
    assert {p.name: p.read_bytes() for p in (tmp_path / "merged").iterdir()} == wanted
    assert verify(bucket, progress=False) == []
    with pytest.raises(StorageError, match="s3://no-such-bucket/set: cannot be written"):
        fake.run(items(fake), "s3://no-such-bucket/set")


@pytest.fixture
def failing(monkeypatch: pytest.MonkeyPatch) -> list[int]:
    """A store at failing://: how many questions it answers, and then how many it does not."""
    import fsspec
    from fsspec.implementations.memory import MemoryFileSystem

    answers = [10**9, 0]

    def asked() -> None:
        answers[0] -= 1
        if answers[0] < 0 < answers[1]:
            answers[1] -= 1
            raise ConnectionResetError("the other side\nhung up")

    class Failing(MemoryFileSystem):
        protocol = "failing"
        store: dict = {}  # noqa: RUF012
        pseudo_dirs = [""]  # noqa: RUF012

    def failing_now(plain):
        def question(*arguments, **how):
            asked()
            return plain(*arguments, **how)

        return question

    for name in ("cat_file", "pipe_file", "ls", "info"):
        setattr(Failing, name, failing_now(getattr(MemoryFileSystem, name)))
    fsspec.register_implementation("failing", Failing, clobber=True)
    _file_system.cache_clear()
    monkeypatch.setattr("qs3.store.folder._PAUSES", (0.0, 0.0))
    return answers


def test_a_dead_store_is_no_missing_data_set(fake, failing):
    fake.run(items(fake), "failing://shelf/set", row=fake.flaky_row)
    failing[:] = 0, 10**9
    message = r"^failing://shelf/set: the store does not answer .*ConnectionResetError: the other s"
    for look in (info, read_ragged, load_clouds, lambda url: verify(url, progress=False)):
        with pytest.raises(StorageError, match=message) as caught:
            look("failing://shelf/set")
        assert "\n" not in str(caught.value)
    with pytest.raises(StorageError, match=message):
        fake.run(items(fake), "failing://shelf/set")
    failing[:] = 0, 2  # it comes back before patience ends
    assert info("failing://shelf/set")["rows"] == 9


@pytest.mark.parametrize("before", [3, 8, 12, 30])
def test_a_store_that_dies_half_way_loses_nothing_and_blames_nobody(
    fake, failing, tmp_path, before
):
    failing[:] = before, 10**9
    with pytest.raises(InputError, match="does not answer"):
        fake.run(items(fake), "failing://shelf/set", row=fake.flaky_row)
    failing[1] = 0
    fake.run(items(fake), "failing://shelf/set", row=fake.flaky_row)
    assert content("failing://shelf/set") == whole(fake, tmp_path / "whole")


def test_a_web_server_that_is_not_there_is_told_as_such(monkeypatch):
    pytest.importorskip("aiohttp")
    monkeypatch.setattr("qs3.store.folder._PAUSES", ())
    with pytest.raises(StorageError, match=r"127.0.0.1:9/set: the store does not answer"):
        info("http://127.0.0.1:9/set")


def test_a_store_that_cannot_be_reached_is_told_in_one_line(fake):
    with pytest.raises(InputError, match="nowhere://a"):
        fake.run(items(fake), "nowhere://a/b")


def test_a_missing_package_is_named_with_its_extra(fake, monkeypatch):
    monkeypatch.setitem(sys.modules, "gcsfs", None)
    with pytest.raises(MissingExtraError, match=r"gcsfs is not installed.*\[gs\]"):
        fake.run(items(fake), "gs://a/b")
