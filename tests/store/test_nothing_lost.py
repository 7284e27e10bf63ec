"""Whatever happens on the way, a data set ends with the same bytes, or says why not."""

import dataclasses
import errno
import os
import resource
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from qs3.errors import InputError
from qs3.files import folder_lock
from qs3.io.layouts.store import read_ragged
from qs3.store.executors import Failure, InlineExecutor, LocalExecutor
from qs3.store.failures import read_failures
from qs3.store.folder import Folder
from qs3.store.generate import GenerateReport
from qs3.store.merge import MergeReport, merge
from qs3.store.verify import verify

HERE = Path(__file__).parent
ROWS, ROWS_PER_SHARD = 24, 4

SCRIPT = """
import signal, sys
sys.path.insert(0, sys.argv[1])
from pathlib import Path
import qs3_fake_scan as fake
from qs3.errors import QS3Error
# Without `if __name__ == "__main__"`: its workers do not run it.
# A job started in the background inherits that Ctrl-C is ignored; this one is to act on it.
signal.signal(signal.SIGINT, signal.default_int_handler)
work = fake.work(24, (9,), "hangs")
try:
    report = fake.run(work, Path(sys.argv[2]), row=getattr(fake, sys.argv[3]), workers=2)
except QS3Error as error:
    print(f"qs3: {error}", file=sys.stderr)
    sys.exit(2)
except KeyboardInterrupt:
    sys.exit(130)
print(report.done, report.skipped, report.failed)
"""


@pytest.fixture
def start(tmp_path):
    """Start a run of 24 scans of 50 ms in a process group of its own."""
    script = tmp_path / "script.py"
    script.write_text(SCRIPT)
    processes = []

    def started(out: Path, row: str = "slow_row", **how) -> subprocess.Popen:
        command = [sys.executable, str(script), str(HERE), str(out), row]
        how |= {"start_new_session": True, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
        processes.append(subprocess.Popen(command, text=True, **how))
        return processes[-1]

    yield started
    for process in processes:  # those that a failed test left
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.communicate()


def written_rows(out: Path) -> int:
    """Scans that are written down, in shards or in parts of shards that are not there yet."""
    parts = [path.parent.name for path in out.glob(".parts/*/[0-9]*.parquet")]
    shards = {path.stem.removeprefix("shard-") for path in out.glob("shard-*.parquet")}
    return len(shards) * ROWS_PER_SHARD + sum(shard not in shards for shard in parts)


def wait_for(condition, seconds: float = 60) -> None:
    deadline = time.monotonic() + seconds
    while not condition() and time.monotonic() < deadline:
        time.sleep(0.01)
    assert condition()


def whole(fake, tmp_path) -> dict[str, bytes]:
    fake.run(fake.work(ROWS, (9,), "hangs"), tmp_path / "whole")
    return fake.content(tmp_path / "whole")


@pytest.mark.slow
def test_a_run_killed_at_ten_moments_ends_the_same(fake, start, tmp_path):
    rng = np.random.default_rng(2)
    out, kills = tmp_path / "out", 10
    rows, shards = [], []
    for kill in range(kills):
        process = start(out)
        goal = int(ROWS * (kill + rng.random()) / (kills + 1))
        wait_for(lambda goal=goal: written_rows(out) >= goal)
        time.sleep(rng.uniform(0, 0.06))  # anywhere within a scan, a write, a shard put together
        assert process.poll() is None, process.communicate()
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate(timeout=60)
        rows.append(written_rows(out))
        shards.append(len(list(out.glob("shard-*.parquet"))))
    process = start(out)
    printed, errors = process.communicate(timeout=120)
    assert process.returncode == 0, errors
    done, skipped, failed = map(int, printed.split())
    assert (done + skipped, failed) == (ROWS, 0)
    assert skipped >= rows[-1]
    assert rows == sorted(rows)  # no scan that was written down was ever lost
    assert sum(count >= 1 for count in shards) >= 5
    assert fake.content(out) == whole(fake, tmp_path)


def test_ctrl_c_keeps_what_is_under_way_and_shows_no_traceback(fake, start, tmp_path):
    out = tmp_path / "out"
    process = start(out)
    wait_for(lambda: written_rows(out) >= ROWS_PER_SHARD)
    os.killpg(process.pid, signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 130, errors
    assert "Traceback" not in errors
    assert 0 < written_rows(out) < ROWS
    fake.run(fake.work(ROWS, (9,), "hangs"), out)
    assert fake.content(out) == whole(fake, tmp_path)


def test_workers_end_with_the_process_that_started_them(start, tmp_path):
    process = start(tmp_path / "out", "deadly_row")
    # One of them hangs by now, with the interpreter locked.
    wait_for(lambda: written_rows(tmp_path / "out") >= 12)
    workers = children(process.pid)
    assert len(workers) >= 2
    os.kill(process.pid, signal.SIGKILL)
    process.communicate(timeout=30)
    wait_for(lambda: not any(alive(pid) for pid in workers))


@pytest.mark.parametrize("row", ["crash_in_write_row", "crash_with_lock_row"])
def test_a_process_that_dies_once_leaves_nothing_undone_and_nothing_behind(
    fake, start, tmp_path, row
):
    marker = tmp_path / "marker"
    process = start(tmp_path / "out", row, env=os.environ | {"QS3_FAKE_MARKER": str(marker)})
    printed, errors = process.communicate(timeout=120)
    assert marker.exists()
    assert (process.returncode, printed.split()) == (0, [str(ROWS), "0", "0"]), errors
    assert fake.content(tmp_path / "out") == whole(fake, tmp_path)


def test_objects_that_hang_or_crash_fail_alone_and_what_was_written_counts(fake, tmp_path):
    items = fake.work(8)
    for row, name in ((2, "hangs"), (5, "crashes"), (6, "late")):
        items[row] = fake.FakeItem(name)
    # A process loads its libraries within the time of its first scan.
    report = fake.run(items, tmp_path, row=fake.deadly_row, workers=2, timeout=12.0)
    assert report == GenerateReport(done=6, skipped=0, failed=2)
    failures = {r["id"]: (r["error"], r["reason"]) for r in read_failures(tmp_path)}
    assert failures["hangs#0"] == ("Timeout", "took over 12 s and was stopped")
    assert failures["crashes#0"][0] == "ProcessDied"
    reason = "its process died 3 times, twice with no other beside it (signal SIGSEGV: a crash)"
    assert failures["crashes#0"][1] == reason
    done = [item for item in items if item.id not in ("hangs", "crashes")]
    assert read_ragged(tmp_path).ids == tuple(f"{item.id}#0" for item in done)
    assert verify(tmp_path, progress=False) == []


def test_what_the_machine_kills_is_no_failure_and_is_made_on_the_next_run(fake, tmp_path):
    items = fake.work(ROWS, (9,), "killed")
    message = r"could not make 1, the first killed9#0: .*SIGKILL.* run the same command again"
    with pytest.raises(InputError, match=message) as caught:
        fake.run(items, tmp_path / "out", row=fake.deadly_row, workers=2)
    assert "\n" not in str(caught.value)
    assert written_rows(tmp_path / "out") == ROWS - 1
    assert read_failures(tmp_path / "out") == []
    report = fake.run(items, tmp_path / "out")
    assert report == GenerateReport(done=1, skipped=ROWS - 1, failed=0)
    fake.run(items, tmp_path / "whole")
    assert fake.content(tmp_path / "out") == fake.content(tmp_path / "whole")


def test_a_machine_that_kills_every_process_is_not_tried_on_and_on(fake, tmp_path):
    items = fake.work(ROWS, tuple(range(ROWS)), "killed")
    with pytest.raises(InputError, match="could not make 5, the first killed0#0"):
        fake.run(items, tmp_path, row=fake.deadly_row, executor=Killer())
    assert read_failures(tmp_path) == []
    assert written_rows(tmp_path) == 0


class Killer(InlineExecutor):
    """Tells of each call that its process was killed."""

    def next(self):
        return self._waiting.popleft()[0], Failure("Killed", "(signal SIGKILL)")


@pytest.mark.parametrize("without_record", [False, True])
def test_what_failed_is_scanned_again_when_asked(fake, tmp_path, monkeypatch, without_record):
    marker = tmp_path / "marker"
    marker.touch()
    monkeypatch.setenv("QS3_FAKE_MARKER", str(marker))
    items = [fake.FakeItem("bad\u2028\u0085é"), *fake.work(ROWS, bad=(5, 6, 23))[1:]]

    def run(**how):
        return fake.run(items, tmp_path / "out", row=fake.marked_row, **how)

    assert run() == GenerateReport(done=20, skipped=0, failed=4)
    assert run() == GenerateReport(done=0, skipped=24, failed=0)
    assert run(retry_failed=True) == GenerateReport(done=0, skipped=20, failed=4)
    assert "bad\u2028\u0085é" in {record["object"] for record in read_failures(tmp_path / "out")}
    marker.unlink()
    if without_record:
        (tmp_path / "out" / "failures.jsonl").unlink()
    assert run(retry_failed=True) == GenerateReport(done=4, skipped=20, failed=0)
    assert read_failures(tmp_path / "out") == []
    fake.run(items, tmp_path / "new")
    assert fake.content(tmp_path / "out") == fake.content(tmp_path / "new")


def test_what_a_power_cut_leaves_is_swept_away(fake, tmp_path):
    """A failure half forgotten, torn files, and the lock of a process that is gone."""
    items = fake.work(ROWS)
    fake.run(items, tmp_path / "whole")
    out = tmp_path / "out"
    with pytest.raises(KeyboardInterrupt):
        fake.run(items, out, row=fake.Interrupting(6))
    for name, text in {
        ".parts/00001/.000003.parquet.4242.tmp.parquet": "PAR1",
        ".parts/00001/.000003.parquet.0123abcd.tmp.parquet": "PAR1",
        ".parts/00000/000001.json": '{"error": "ValueError", "reason": "broken"}',
        ".shard-00001.parquet.7.tmp.parquet": "PAR1",
        ".lock": "process 1 on nowhere",
    }.items():
        (out / name).parent.mkdir(exist_ok=True)
        (out / name).write_text(text)
    fake.run(items, out)
    assert fake.content(out) == fake.content(tmp_path / "whole")


def test_a_scan_that_was_made_and_is_gone_is_never_passed_over(fake, tmp_path, monkeypatch):
    """As where machines see two folders under one name."""
    write = Folder.write

    def elsewhere(self, name, data):
        if "00001/000002" not in name:
            write(self, name, data)

    monkeypatch.setattr(Folder, "write", elsewhere)
    with pytest.raises(InputError, match=r"shard-00001\.parquet: 1 scans that were made are not"):
        fake.run(fake.work(ROWS), tmp_path / "out")
    monkeypatch.undo()
    assert not (tmp_path / "out" / "shard-00001.parquet").exists()
    fake.run(fake.work(ROWS), tmp_path / "whole")
    fake.run(fake.work(ROWS), tmp_path / "out")
    assert fake.content(tmp_path / "out") == fake.content(tmp_path / "whole")


def test_a_fault_of_the_machine_does_not_go_through_the_whole_list(fake, tmp_path):
    items = fake.work(63, bad=tuple(range(3, 63)))
    with pytest.raises(InputError, match="50 objects in a row failed, the last with: bad52"):
        fake.run(items, tmp_path, row=fake.flaky_row)
    report = fake.run(items, tmp_path, row=fake.flaky_row)  # and past them, if they are at fault
    assert report == GenerateReport(done=0, skipped=53, failed=10)
    assert verify(tmp_path, progress=False) == []


def test_workers_use_one_thread_each():
    with LocalExecutor(1) as executor:
        executor.submit(0, threads_here)
        assert executor.next() == (0, {1})


def threads_here() -> set[int]:
    """Threads of the linear algebra and picture libraries of this process."""
    import cv2
    import scipy.linalg  # noqa: F401
    import threadpoolctl

    pools = {pool["num_threads"] for pool in threadpoolctl.threadpool_info()}
    return pools | {cv2.getNumThreads()}


@pytest.mark.slow
def test_what_is_slow_to_unpack_stops_no_other_worker():
    """As the first call is on a busy machine: it imports what it is made of."""
    with LocalExecutor(2) as executor:
        for key in range(4):
            executor.submit(key, str, SlowToUnpack())
        assert sorted(executor.next() for _ in range(4)) == [(key, "None") for key in range(4)]


class SlowToUnpack:
    """Takes longer to unpack than a worker waits for the lock that all share."""

    def __reduce__(self):
        return time.sleep, (6.0,)


def test_every_state_between_two_writes_is_mended(fake, tmp_path, monkeypatch):
    """Stop after each single write of a run with failures, and go on: always the same end."""

    class Stop(BaseException):
        """As abrupt as a power cut."""

    items = fake.work(10, bad=(1,))
    fake.run(items, tmp_path / "whole", row=fake.flaky_row)
    wanted = fake.content(tmp_path / "whole")
    left = [0]

    def counted(change):
        def changed(self, *arguments):
            if left[0] == 0:
                raise Stop
            left[0] -= 1
            return change(self, *arguments)

        return changed

    monkeypatch.setattr(Folder, "write", counted(Folder.write))
    monkeypatch.setattr(Folder, "remove", counted(Folder.remove))
    stops = 0
    for steps in range(1, 100):
        out = tmp_path / f"out{steps}"
        left[0] = steps
        try:
            fake.run(items, out, row=fake.flaky_row)
        except Stop:
            stops += 1
        else:
            break
        left[0] = -1
        fake.run(items, out, row=fake.flaky_row)
        assert fake.content(out) == wanted, steps
    assert stops > 15


@pytest.fixture
def small_disk(tmp_path):
    """A file system of 64 KiB, where this user may mount one; else None."""
    folder = tmp_path / "disk"
    folder.mkdir()
    command = ["mount", "-t", "tmpfs", "-o", "size=64k", "tmpfs", str(folder)]
    try:
        mounted = subprocess.run(command, capture_output=True, check=False).returncode == 0
    except FileNotFoundError:
        mounted = False
    yield folder if mounted else None
    if mounted:
        subprocess.run(["umount", str(folder)], check=True)


def test_a_full_disk_stops_the_run_and_loses_nothing(fake, start, tmp_path, small_disk):
    """On a small file system where one can be mounted, else under a limit of the file size."""
    if small_disk is not None:
        out, limit = small_disk / "out", None
    else:
        out = tmp_path / "out"

        def limit():
            resource.setrlimit(resource.RLIMIT_FSIZE, (12_000, 12_000))

    process = start(out, "fake_row", preexec_fn=limit)
    _, errors = process.communicate(timeout=120)
    assert process.returncode == 2, errors
    assert len(errors.strip().splitlines()) == 1
    assert "No space left on device" in errors or "File too large" in errors
    before = written_rows(out)
    if small_disk is not None:
        subprocess.run(["mount", "-o", "remount,size=4m", str(small_disk)], check=True)
    report = fake.run(fake.work(ROWS, (9,), "hangs"), out)
    assert (report.done + report.skipped, report.failed) == (ROWS, 0)
    assert report.skipped >= before > 0
    assert fake.content(out) == whole(fake, tmp_path)


def test_parts_of_several_machines_merge_into_the_bytes_of_one(fake, tmp_path):
    items = fake.work(ROWS, bad=(3, 20))
    merged = tmp_path / "merged"
    fake.run(items, tmp_path / "whole", row=fake.flaky_row)
    parts = [tmp_path / f"part{i}" for i in range(4)]
    reports = [
        fake.run(items, part, row=fake.flaky_row, shard=(i, 4)) for i, part in enumerate(parts)
    ]
    assert sum(report.done + report.failed for report in reports) == ROWS
    with pytest.raises(InputError, match=r"2 of 6 shards are in none .* \(numbers 1, 5\)"):
        merge([parts[0], *parts[2:]], merged, progress=False)
    assert not merged.exists()
    report = merge(parts, merged, progress=False)
    assert report == MergeReport(copied=6, skipped=0, failed=2)
    assert fake.content(merged) == fake.content(tmp_path / "whole")
    assert merge(parts, merged, progress=False).copied == 0
    fake.run(items, tmp_path / "other", dataclasses.replace(fake.SETTINGS, seed=1))
    with pytest.raises(InputError, match="seed = 1, not 0"):
        merge([*parts, tmp_path / "other"], merged, progress=False)
    assert fake.run(items, merged, retry_failed=True).done == 2
    with pytest.raises(InputError, match="neither part's any more"):
        merge(parts, merged, progress=False)
    assert read_failures(merged) == []
    (tmp_path / "part2" / "shard-00002.parquet").write_bytes(b"PAR1")
    with pytest.raises(InputError, match=r"part2/shard-00002\.parquet: damaged"):
        merge(parts, tmp_path / "fresh", progress=False)


@pytest.mark.parametrize("writes", [0, 1, 2, 5])
def test_a_disk_that_fills_while_parts_are_merged(fake, tmp_path, monkeypatch, writes):
    items, merged = fake.work(ROWS), tmp_path / "merged"
    fake.run(items, tmp_path / "whole")
    sync, left = os.fsync, [2 * writes]  # of the file, and of the folder with its name

    def full(handle):
        left[0] -= 1
        if left[0] < 0:
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        sync(handle)

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(InputError, match=r"merged/.*No space left on device.*run the same command"):
        merge([tmp_path / "whole"], merged, progress=False)
    assert merged.exists() == (merged / "dataset.json").is_file() == (writes > 0)
    monkeypatch.undo()
    merge([tmp_path / "whole"], merged, progress=False)
    assert fake.content(merged) == fake.content(tmp_path / "whole")


def test_a_worker_that_dies_twice_for_want_of_room_is_tried_alone(tmp_path):
    with LocalExecutor(2) as executor:
        executor.submit("slow", time.sleep, 1.0)
        executor.submit("shy", die_beside_others, tmp_path)
        assert dict([executor.next(), executor.next()]) == {"slow": None, "shy": 3}


def die_beside_others(folder: Path) -> int:
    """Be killed twice, as by a system short of memory; return the number of the try."""
    number = len(list(folder.iterdir())) + 1
    (folder / str(number)).touch()
    if number < 3:
        os.kill(os.getpid(), signal.SIGKILL)
    return number


def test_a_part_that_is_not_there_is_refused(fake, tmp_path):
    for shard in ((1, 1), (-1, 2)):
        with pytest.raises(InputError, match="shard"):
            fake.run(fake.work(4), tmp_path / "out", shard=shard)
    assert not (tmp_path / "out").exists()


def test_two_runs_do_not_write_into_one_folder(fake, tmp_path):
    with folder_lock(tmp_path), pytest.raises(InputError, match="another qs3 is writing"):
        fake.run(fake.work(4), tmp_path)
    assert fake.content(tmp_path) == {}


def test_half_precision_is_the_nearest_half(fake, tmp_path):
    for dtype in ("float32", "float16"):
        settings = dataclasses.replace(fake.SETTINGS, dtype=dtype)
        fake.run(fake.work(ROWS), tmp_path / dtype, settings)
    single, half = (np.stack(read_ragged(tmp_path / d).clouds) for d in ("float32", "float16"))
    assert half.dtype == np.float32
    np.testing.assert_array_equal(half, single.astype(np.float16).astype(np.float32))
    assert verify(tmp_path / "float16", progress=False) == []


def test_executors_refuse_numbers_out_of_range():
    for how in ({"workers": 0}, {"workers": -1}, {"timeout": 0.0}):
        with pytest.raises(InputError):
            LocalExecutor(**how)
    with InlineExecutor() as executor:
        executor.submit("a", int, "7")
        assert executor.next() == ("a", 7)


def children(pid: int) -> list[int]:
    """Processes that a process started."""
    pids = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                fields = (entry / "stat").read_text().rsplit(")", 1)[1].split()
            except OSError:
                continue
            if int(fields[1]) == pid:
                pids.append(int(entry.name))
    return sorted(pids)


def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False
