"""Files appear whole, temporary folders are fresh, and one process at a time holds a folder."""

import errno
import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from qs3.errors import InputError, StorageError
from qs3.files import (
    LOCK,
    atomic_path,
    claim_folder,
    folder_lock,
    holds_something,
    new_folder,
    parse_json,
    read_json,
    remove_left_overs,
    sub_folder,
    temporary_folder,
    write_bytes,
    write_json,
)


def names(folder: Path) -> list[str]:
    return sorted(entry.name for entry in folder.iterdir())


def test_a_file_is_whole_or_as_it_was(tmp_path: Path) -> None:
    target = tmp_path / "a.json"
    write_json(target, {"a": 1})
    with pytest.raises(RuntimeError), atomic_path(target) as temporary:
        temporary.write_text("half")
        raise RuntimeError
    assert read_json(target) == {"a": 1}
    assert names(tmp_path) == ["a.json"]


def test_left_overs_are_known_and_removed_and_nothing_else(tmp_path: Path) -> None:
    for name in (".a.json.4242.tmp.json", ".a.json.0123abcd.tmp.json", LOCK):
        (tmp_path / name).touch()
    assert not holds_something(tmp_path)
    (tmp_path / ".a.backup.tmp").touch()
    assert holds_something(tmp_path)
    remove_left_overs(tmp_path)
    assert names(tmp_path) == [".a.backup.tmp", LOCK]


def test_a_full_disk_is_told_by_the_files_name_and_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    for name in ("fsync", "pwrite"):
        with monkeypatch.context() as patch:
            patch.setattr(os, name, full)
            with pytest.raises(StorageError, match=r"No space left on device.*make room") as caught:
                (write_json if name == "fsync" else hold)(tmp_path / "a", {})
            assert str(caught.value).startswith(f"{tmp_path / 'a'}")
        assert names(tmp_path) in ([], ["a"])
        assert not (tmp_path / "a").is_file()


def hold(folder: Path, _: object) -> None:
    folder.mkdir()
    with folder_lock(folder):
        pass


LARGE = "1" + "0" * 400 + ".0"
LONE = r'{"a": "\ud83d"}'


@pytest.mark.parametrize(
    "text",
    [
        "",
        "{",
        "NaN",
        "[Infinity]",
        "[1e999]",
        LARGE,
        LONE,
        "9" * 5000,
        "[" * 100_000,
        "\udc80",
        b"\xff",
    ],
)
def test_json_is_strict(text: str | bytes) -> None:
    with pytest.raises(InputError, match=r"^a\.json: not a JSON file") as caught:
        parse_json(text, "a.json")
    assert str(caught.value).encode()
    assert parse_json(r'"\ud83d\ude00 1e9999"', "a.json") == "\U0001f600 1e9999"
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_json(Path("never"), float("nan"))


def test_a_temporary_folder_is_fresh_and_goes(tmp_path: Path) -> None:
    target, elsewhere = tmp_path / "data", tmp_path / "elsewhere"
    elsewhere.mkdir()
    (elsewhere / "mine").touch()
    (tmp_path / ".data.aaaaaaaa.tmp").symlink_to(elsewhere)
    (tmp_path / ".data.bbbbbbbb.tmp").mkdir()  # somebody's, without our mark
    abandoned = tmp_path / ".data.cccccccc.tmp"
    abandoned.mkdir()
    (abandoned / LOCK).write_text("process 1 on nowhere")
    with temporary_folder(target) as first, temporary_folder(target) as second:
        assert first.parent == second.parent == tmp_path
        assert first != second
        assert names(first) == names(second) == [LOCK]
        (first / "half").touch()
    assert names(tmp_path) == [".data.aaaaaaaa.tmp", ".data.bbbbbbbb.tmp", "elsewhere"]
    assert (elsewhere / "mine").exists()


def test_what_comes_into_a_new_folder_meanwhile_stays(tmp_path: Path) -> None:
    target = tmp_path / "data"
    target.mkdir()
    (target / LOCK).touch()  # a killed process's
    with new_folder(target) as whole:
        whole.mkdir()
        (target / ".a.json.4242.tmp.json").touch()
    assert names(target) == []
    refused = pytest.raises(InputError, match="data: was empty, but something has come meanwhile")
    with refused, new_folder(target) as whole:
        whole.mkdir()
        (target / "mine").touch()
    assert (names(tmp_path), names(target)) == (["data"], ["mine"])


@pytest.mark.parametrize("name", ["a" * 255, "ä" * 127, "a." + "b" * 253])
def test_a_name_of_any_length_has_a_temporary_one(tmp_path: Path, name: str) -> None:
    for _ in range(2):
        with atomic_path(tmp_path / name) as temporary:
            temporary.touch()
        with temporary_folder(tmp_path / name) as folder:
            assert folder.is_dir()
    assert names(tmp_path) == [name]


def test_a_link_in_place_of_the_lock_is_not_followed(tmp_path: Path) -> None:
    (tmp_path / "mine").write_text("precious")
    (tmp_path / LOCK).symlink_to(tmp_path / "mine")
    with pytest.raises(InputError, match=r"\.lock: is a link"), folder_lock(tmp_path):
        pass
    assert (tmp_path / "mine").read_text() == "precious"


def test_a_link_in_place_of_a_sub_folder_is_not_followed(tmp_path: Path) -> None:
    (tmp_path / "mine").mkdir()
    (tmp_path / "records").symlink_to(tmp_path / "mine")
    with pytest.raises(InputError, match="records: is a link, which qs3 does not follow"):
        sub_folder(tmp_path / "records")
    for _ in range(2):
        assert sub_folder(tmp_path / "others").is_dir()


def test_a_folder_has_one_holder_at_a_time(tmp_path: Path) -> None:
    refused = pytest.raises(InputError, match=rf"process {os.getpid()} on .*; wait for it")
    with folder_lock(tmp_path), refused, folder_lock(tmp_path):
        pass
    assert names(tmp_path) == []
    with folder_lock(tmp_path):
        pass


def test_a_killed_process_lets_go(tmp_path: Path) -> None:
    script = "import sys, time; from pathlib import Path; from qs3.files import folder_lock\n"
    script += "with folder_lock(Path(sys.argv[1])): print('held', flush=True); time.sleep(60)"
    command = [sys.executable, "-c", script, str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "held\n"
        with pytest.raises(InputError, match=f"process {process.pid} on"):
            folder_lock(tmp_path).__enter__()
        process.send_signal(signal.SIGKILL)
    assert names(tmp_path) == [LOCK]
    with folder_lock(tmp_path):
        pass


def test_where_a_file_system_has_no_locks_the_name_decides(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    fcntl = pytest.importorskip("fcntl")

    def refuse(*arguments: object) -> None:
        raise OSError("no locks here")

    monkeypatch.setattr(fcntl, "flock", refuse)
    lock = tmp_path / LOCK
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    machine = os.uname().nodename
    for holder, free in {
        f"process {ended.pid} on {machine}": True,
        f"process {os.getppid()} on {machine}": False,
        "process 5 on elsewhere": False,
    }.items():
        lock.write_text(holder)
        if free:
            with folder_lock(tmp_path):
                assert lock.read_text() == f"process {os.getpid()} on {machine}"
        else:
            with pytest.raises(InputError, match=rf"{holder}.* remove .*\.lock"):
                folder_lock(tmp_path).__enter__()


def test_a_folder_is_claimed_only_where_it_is_empty_or_ours(tmp_path: Path) -> None:
    assert claim_folder(tmp_path / "new", "mark").is_dir()
    (tmp_path / "new" / "mark").touch()
    claim_folder(tmp_path / "new", "mark")
    with pytest.raises(InputError, match="holds something else"):
        claim_folder(tmp_path, "mark")
    with pytest.raises(InputError, match="is a file"):
        claim_folder(tmp_path / "new" / "mark", "mark")


def test_a_fault_of_writing_names_the_file_and_not_what_came_before_it(tmp_path: Path) -> None:
    (tmp_path / "taken").mkdir()
    with pytest.raises(OSError) as caught:
        write_bytes(tmp_path / "taken", b"x")
    assert caught.value.filename == str(tmp_path / "taken")
    assert [path.name for path in tmp_path.iterdir()] == ["taken"]
