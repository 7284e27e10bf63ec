"""Files appear whole, temporary folders are fresh, and one process at a time holds a folder."""

import csv
import errno
import os
import signal
import stat
import subprocess
import sys
import time
from pathlib import Path

import pytest

from qs3.errors import InputError, StorageError
from qs3.escapes import csv_text, plain
from qs3.files import (
    LOCK,
    check_output,
    claim_folder,
    folder_lock,
    holds_something,
    new_folder,
    parse_json,
    read_json,
    remove_left_overs,
    state_of,
    write_bytes,
    write_json,
)


def names(folder: Path) -> list[str]:
    return sorted(entry.name for entry in folder.iterdir())


def test_a_file_is_whole_or_as_it_was(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    target = tmp_path / "a.json"
    write_json(target, {"a": 1})
    monkeypatch.setattr(Path, "replace", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_json(target, {"a": 2})
    assert read_json(target) == {"a": 1}
    assert names(tmp_path) == ["a.json"]


def test_what_is_written_is_on_disk_before_it_takes_its_place(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Else a power cut could leave an empty file; then the name is brought to disk, too."""
    done: list[str | int] = []
    for name in ("replace", "rename"):
        plain = getattr(Path, name)
        monkeypatch.setattr(Path, name, lambda *a, plain=plain: done.append("moved") or plain(*a))
    monkeypatch.setattr(os, "fsync", lambda handle: done.append(os.fstat(handle).st_ino))
    write_bytes(tmp_path / "a", b"whole")
    assert done == [(tmp_path / "a").stat().st_ino, "moved", tmp_path.stat().st_ino]
    done.clear()
    with new_folder(tmp_path / "b") as folder:
        folder.mkdir()
        (folder / "c").write_bytes(b"whole")
    assert done.index((tmp_path / "b" / "c").stat().st_ino) < done.index("moved")
    assert done[-1] == tmp_path.stat().st_ino


def test_a_folder_that_cannot_be_opened_takes_files(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    opened = os.open

    def only_files(path: Path, flags: int, *more: int) -> int:
        if Path(path).is_dir():
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(path))
        return opened(path, flags, *more)

    monkeypatch.setattr(os, "open", only_files)
    write_bytes(tmp_path / "a", b"whole")
    assert (tmp_path / "a").read_bytes() == b"whole"


def test_left_overs_are_known_and_removed_and_nothing_else(tmp_path: Path) -> None:
    for name in (".0123456789abcdef.tmp.json", LOCK):
        (tmp_path / name).touch()
    assert not holds_something(tmp_path)
    (tmp_path / ".a.backup.tmp").touch()
    assert holds_something(tmp_path)
    remove_left_overs(tmp_path)
    assert names(tmp_path) == [".a.backup.tmp", LOCK]


def test_a_full_disk_names_the_file_and_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(StorageError, match=r"a: cannot be written \(No space left.*make room"):
        write_json(tmp_path / "a", {})
    assert names(tmp_path) == []


def test_a_full_disk_names_the_new_folder_and_leaves_nothing(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A library that writes into it names no file."""
    monkeypatch.chdir(tmp_path)
    fault = r"^a: cannot be written \(No space left.*make room"
    with pytest.raises(StorageError, match=fault), new_folder(Path("a")) as folder:
        folder.mkdir()
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    assert names(tmp_path) == []


def test_pipes_open_files_and_links_are_written_to_and_never_replaced(tmp_path: Path) -> None:
    pipe, link, target = tmp_path / "pipe", tmp_path / "link.csv", tmp_path / "target.csv"
    os.mkfifo(pipe)
    target.write_bytes(b"old")
    link.symlink_to(target)
    with subprocess.Popen(["cat", pipe], stdout=subprocess.PIPE) as reader:
        write_bytes(pipe, b"through")
        assert reader.communicate()[0] == b"through"
    assert pipe.is_fifo()
    write_bytes(link, b"new")
    assert (link.is_symlink(), target.read_bytes()) == (True, b"new")
    with (tmp_path / "out").open("wb", buffering=0) as out:
        out.write(b"before ")
        (tmp_path / "stdout").symlink_to(f"/dev/fd/{out.fileno()}")
        write_bytes(tmp_path / "stdout", b"after")
        assert (tmp_path / "out").stat().st_ino == os.fstat(out.fileno()).st_ino
    assert (tmp_path / "out").read_bytes() == b"before after"
    assert names(tmp_path) == ["link.csv", "out", "pipe", "stdout", "target.csv"]
    null = tmp_path / "null"
    try:
        os.mknod(null, stat.S_IFCHR | 0o666, os.makedev(1, 3))
        write_bytes(null, b"x")
    except PermissionError:
        return
    assert null.is_char_device()


def test_a_file_of_another_kind_is_not_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "cloud.xyz"
    path.write_bytes(b"0 0 0")
    with pytest.raises(InputError, match=r"--out .*is there already and may be a cloud or other"):
        check_output(path, "--out", ".csv", ".json")
    assert path.read_bytes() == b"0 0 0"
    with pytest.raises(InputError, match="cannot be written there"):
        check_output(path / "a.csv", "--out", ".csv")
    for fine, begin in {"new.doc": None, "a.csv": b"file,class", "c": b""}.items():
        if begin is not None:
            (tmp_path / fine).write_bytes(begin)
        check_output(tmp_path / fine, "--out", ".csv", ".json")


def test_cells_of_a_csv_compute_nothing(tmp_path: Path) -> None:
    words = ["=1+1", "+x", "-x", "@x", "\tx", "\rx", " =1", "a\x1b[2J\u202e", "-1.5", "plain"]
    text = csv_text(["name", "n"], [{"name": word, "n": -2.5} for word in words])
    table = list(csv.reader(text.splitlines()))
    assert table[0] == ["name", "n"]
    for word, (shown, number) in zip(words, table[1:], strict=True):
        assert shown[0] not in "=+@\t\r"
        assert shown == word or shown[0] != "-"
        assert shown.isprintable()
        assert number == "-2.5"
        assert plain(shown) == word or not word.isprintable() or word[0] == " "


def test_a_new_folder_is_whole_or_absent_and_spares_what_came_meanwhile(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    target, left = tmp_path / "data", tmp_path / ".data.tmp" / "data"
    left.mkdir(parents=True)
    (left / "torn").touch()  # by a killed process
    target.mkdir()
    synced = []
    monkeypatch.setattr("qs3.files._sync", synced.append)
    with new_folder(target) as whole:
        whole.mkdir()
        (whole / "a").touch()
    assert synced == [whole, whole / "a", tmp_path]
    assert (names(tmp_path), names(target)) == (["data"], ["a"])
    (target / "a").unlink()
    with pytest.raises(InputError, match="data: is there already"), new_folder(target) as whole:
        whole.mkdir()
        (target / "mine").touch()
    assert (names(tmp_path), names(target)) == (["data"], ["mine"])
    with pytest.raises(RuntimeError), new_folder(tmp_path / "other") as whole:
        whole.mkdir()
        raise RuntimeError
    assert names(tmp_path) == ["data"]


@pytest.mark.parametrize("step", ["sync", "move"])
@pytest.mark.parametrize("fault", [OSError(errno.ENOSPC, "No space left"), KeyboardInterrupt()])
def test_a_folder_that_a_new_one_does_not_replace_stays_whole(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, step: str, fault: BaseException
) -> None:
    run, moved = tmp_path / "run", Path.rename
    run.mkdir()
    (run / "old").touch()

    def rename(path: Path, to: Path) -> Path:
        if step == "move" and path.name == "run" and to == run:  # the new one
            raise fault
        return moved(path, to)

    def sync(_: Path) -> None:
        if step == "sync":
            raise fault

    monkeypatch.setattr(Path, "rename", rename)
    monkeypatch.setattr("qs3.files._sync", sync)
    expected = pytest.raises((StorageError, KeyboardInterrupt))
    with expected, new_folder(run, over=True) as whole:
        whole.mkdir()
        (whole / "new").touch()
    assert (names(tmp_path), names(run)) == (["run"], ["old"])


def test_no_disk_is_needed_once_the_old_folder_is_moved(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*_: object, **__: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    run = tmp_path / "run"
    run.mkdir()
    (run / "old").touch()
    with new_folder(run, over=True) as whole:
        whole.mkdir()
        (whole / "new").touch()
        monkeypatch.setattr("tempfile.TemporaryFile", full)
    assert (names(tmp_path), names(run)) == (["run"], ["new"])


def test_an_old_folder_comes_back_if_the_process_was_killed_between_two_renames(
    tmp_path: Path,
) -> None:
    before = tmp_path / ".run.tmp" / ".before"
    before.mkdir(parents=True)
    (before / "old").touch()
    with pytest.raises(RuntimeError), new_folder(tmp_path / "run", over=True):
        raise RuntimeError
    assert (names(tmp_path), names(tmp_path / "run")) == (["run"], ["old"])


@pytest.mark.parametrize(
    "text", ["", "{", "NaN", "[Infinity]", "9" * 5000, "[" * 100_000, "\udc80", b"\xff"]
)
def test_json_is_strict(text: str | bytes) -> None:
    with pytest.raises(InputError, match=r"^a\.json: not a JSON file") as caught:
        parse_json(text, "a.json")
    assert str(caught.value).encode()
    with pytest.raises(ValueError, match="not JSON compliant"):
        write_json(Path("never"), float("nan"))


def test_a_folder_has_one_holder_at_a_time(tmp_path: Path) -> None:
    refused = pytest.raises(InputError, match=r"another qs3 is writing .*; wait for it")
    with folder_lock(tmp_path), refused, folder_lock(tmp_path):
        pass
    with folder_lock(tmp_path):
        pass


def test_a_killed_process_lets_go(tmp_path: Path) -> None:
    script = "import sys, time; from pathlib import Path; from qs3.files import folder_lock\n"
    script += "with folder_lock(Path(sys.argv[1])): print('held', flush=True); time.sleep(60)"
    command = [sys.executable, "-c", script, str(tmp_path)]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout.readline() == "held\n"
        with pytest.raises(InputError, match="another qs3"):
            folder_lock(tmp_path).__enter__()
        process.send_signal(signal.SIGKILL)
    with folder_lock(tmp_path):
        pass


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


@pytest.mark.parametrize(
    "write",
    [
        lambda path: write_bytes(path, b""),
        lambda path: check_output(path, "--csv"),
        lambda path: claim_folder(path, "run.json"),
        lambda path: new_folder(path).__enter__(),
    ],
)
def test_a_link_that_leads_nowhere_is_named(tmp_path: Path, write) -> None:
    loop = tmp_path / "loop"
    loop.symlink_to("loop")
    for path in (loop, loop / "a"):
        with pytest.raises(InputError, match=r"loop(/a)?: is a link that leads back to itself"):
            write(path)
    assert names(tmp_path) == ["loop"]


def test_a_dangling_link_is_no_new_folder(tmp_path: Path) -> None:
    (tmp_path / "out").symlink_to("gone")
    with pytest.raises(InputError, match="is a link to gone, which is not there"):
        claim_folder(tmp_path / "out", "run.json")


@pytest.mark.parametrize("disk", ["old", "fresh", "written all the time", "counts seconds"])
def test_the_state_of_a_file_comes_soon_and_returns_only_if_no_change_could_escape(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, disk: str
) -> None:
    now = [10**18 + (0 if disk == "counts seconds" else 5)]
    changed = [now[0] - 10**10 * (disk == "old")]
    waits: list[float] = []

    def sleep(seconds: float) -> None:
        assert len(waits) < 9, "waits without an end"
        waits.append(seconds)
        now[0] += int(seconds * 1e9)
        if disk == "written all the time":
            changed[0] = now[0]

    def stat(self: Path) -> os.stat_result:
        facts = {"st_mtime_ns": changed[0], "st_ctime_ns": changed[0]}
        return os.stat_result((0o100644, 1, 2, 1, 0, 0, 4, 0, 0, 0), facts)

    monkeypatch.setattr(time, "sleep", sleep)
    monkeypatch.setattr(time, "time_ns", lambda: now[0])
    monkeypatch.setattr(Path, "stat", stat)
    states = [state_of(tmp_path / "a") for _ in range(2)]
    monkeypatch.undo()
    assert (states[0] == states[1]) == (disk in {"old", "fresh"})
    assert sum(waits) <= 0.05
