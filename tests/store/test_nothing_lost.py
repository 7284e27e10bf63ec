"""Whatever happens on the way, a data set ends with the same bytes, or says why not."""

import dataclasses
import os
import resource
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import numpy as np
import pytest

from qs3.clouds.layouts.store import read_ragged
from qs3.errors import InputError
from qs3.files import folder_lock
from qs3.store.executors import InlineExecutor, LocalExecutor
from qs3.store.info import check
from qs3.store.manifest import Report, read_failures
from qs3.store.merge import merge

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

    def started(out: Path, row: str = "slow_row", **options) -> subprocess.Popen:
        command = [sys.executable, str(script), str(HERE), str(out), row]
        options |= {"start_new_session": True, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
        processes.append(subprocess.Popen(command, text=True, **options))
        return processes[-1]

    yield started
    for process in processes:  # those that a failed test left
        if process.poll() is None:
            os.killpg(process.pid, signal.SIGKILL)
            process.communicate()


def shards(out: Path) -> int:
    return len(list(out.glob("shard-*.parquet")))


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
    finished = []
    for kill in range(kills):
        process = start(out)
        goal = kill * ROWS // ROWS_PER_SHARD // kills
        wait_for(lambda goal=goal: shards(out) >= goal)
        time.sleep(rng.uniform(0, 0.06))  # anywhere within a scan or a write
        assert process.poll() is None, process.communicate()
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate(timeout=60)
        finished.append(shards(out))
    process = start(out)
    printed, errors = process.communicate(timeout=120)
    assert process.returncode == 0, errors
    done, skipped, failed = map(int, printed.split())
    assert (done + skipped, failed) == (ROWS, 0)
    assert skipped == finished[-1] * ROWS_PER_SHARD > 0
    assert finished == sorted(finished)
    assert fake.content(out) == whole(fake, tmp_path)


def test_ctrl_c_keeps_the_finished_shards_and_shows_no_traceback(fake, start, tmp_path):
    out = tmp_path / "out"
    process = start(out)
    wait_for(lambda: shards(out) >= 1)
    os.killpg(process.pid, signal.SIGINT)
    _, errors = process.communicate(timeout=60)
    assert process.returncode == 130, errors
    assert "Traceback" not in errors
    fake.run(fake.work(ROWS, (9,), "hangs"), out)
    assert fake.content(out) == whole(fake, tmp_path)


def test_workers_end_with_the_process_that_started_them(start, tmp_path):
    process = start(tmp_path / "out", "deadly_row")
    # One of them hangs by now, with the interpreter locked.
    wait_for(lambda: shards(tmp_path / "out") >= 4)
    workers = children(process.pid)
    assert len(workers) >= 2
    os.kill(process.pid, signal.SIGKILL)
    process.communicate(timeout=30)
    wait_for(lambda: not any(alive(pid) for pid in workers))


def test_objects_that_hang_or_crash_fail_alone(fake, tmp_path, capfd):
    """No process runs Python on its way: a signal amid a compilation would end in a traceback."""
    items = fake.work(9)
    for row, name in ((2, "hangs"), (5, "crashes"), (6, "exits"), (7, "is told to end")):
        items[row] = fake.mesh(name)
    # A process loads its libraries within the time of its first scan.
    report = fake.run(items, tmp_path, row=fake.deadly_row, workers=2, timeout=8.0)
    assert report == Report(done=5, skipped=0, failed=4)
    failures = {r["id"]: (r["error"], r["reason"]) for r in read_failures(tmp_path)}
    assert failures == {
        "hangs#0": ("Timeout", "took over 8 s and was stopped"),
        "crashes#0": ("ProcessDied", "its process died (signal SIGSEGV)"),
        "exits#0": ("ProcessDied", "its process died (exit code 9)"),
        "is told to end#0": ("ProcessDied", "its process died (signal SIGTERM)"),
    }
    assert "Traceback" not in capfd.readouterr().err
    assert len(read_ragged(tmp_path).ids) == 5
    assert check(tmp_path, progress=False) == []


@pytest.mark.parametrize("without_record", [False, True])
def test_what_failed_is_scanned_again_when_asked(fake, tmp_path, monkeypatch, without_record):
    marker = tmp_path / "marker"
    marker.touch()
    monkeypatch.setenv("QS3_FAKE_MARKER", str(marker))
    items = [fake.mesh("bad\u2028\u0085é"), *fake.work(ROWS, bad=(5, 6, 23))[1:]]

    def run(**options):
        return fake.run(items, tmp_path / "out", row=fake.marked_row, **options)

    assert run() == Report(done=20, skipped=0, failed=4)
    assert run() == Report(done=0, skipped=24, failed=0)
    assert run(retry_failed=True) == Report(done=0, skipped=20, failed=4)
    assert "bad\u2028\u0085é" in {record["object"] for record in read_failures(tmp_path / "out")}
    marker.unlink()
    if without_record:
        (tmp_path / "out" / "failures.jsonl").unlink()
    assert run(retry_failed=True) == Report(done=4, skipped=20, failed=0)
    assert read_failures(tmp_path / "out") == []
    fake.run(items, tmp_path / "new")
    assert fake.content(tmp_path / "out") == fake.content(tmp_path / "new")


def test_every_state_between_two_writes_is_mended(fake, tmp_path, monkeypatch):
    """Stop after each single write of a run with failures, and go on: always the same end."""

    class Stop(BaseException):
        """As abrupt as a power cut."""

    items = fake.work(10, bad=(1, 9))
    fake.run(items, tmp_path / "whole", row=fake.flaky_row)
    wanted = fake.content(tmp_path / "whole")
    replace, left = Path.replace, [0]

    def counted(self, target):
        if left[0] == 0:
            raise Stop
        left[0] -= 1
        return replace(self, target)

    monkeypatch.setattr(Path, "replace", counted)
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
        (out / ".0123456789abcdef.tmp.parquet").write_text("PAR1")  # torn
        fake.run(items, out, row=fake.flaky_row)
        assert fake.content(out) == wanted, steps
    assert stops == 5  # manifest, then three shards and two entries of the log


def test_workers_use_one_thread_each():
    with LocalExecutor(1) as executor:
        executor.submit(0, threads_here)
        assert executor.next() == (0, {1})


def test_the_bars_of_workers_leave_nothing_behind():
    """A semaphore of a worker that is stopped would be warned of when the first process ends."""
    with LocalExecutor(1) as executor:
        executor.submit(0, lock_of_bars)
        assert executor.next() == (0, True)


def lock_of_bars() -> bool:
    from tqdm import tqdm

    with tqdm(total=1, disable=True):
        return isinstance(tqdm.get_lock(), type(threading.RLock()))


def threads_here() -> set[int]:
    """Threads of the linear algebra and picture libraries of this process."""
    import cv2
    import scipy.linalg  # noqa: F401
    import threadpoolctl

    pools = {pool["num_threads"] for pool in threadpoolctl.threadpool_info()}
    return pools | {cv2.getNumThreads()}


def test_a_full_disk_stops_the_run_and_loses_nothing(fake, start, tmp_path):
    """A limit of the file size stands in for a full disk."""
    out = tmp_path / "out"

    def limit():
        resource.setrlimit(resource.RLIMIT_FSIZE, (6_000, 6_000))

    process = start(out, "fake_row", preexec_fn=limit)
    _, errors = process.communicate(timeout=120)
    assert process.returncode == 2, errors
    assert len(errors.strip().splitlines()) == 1
    assert "File too large" in errors
    before = shards(out) * ROWS_PER_SHARD
    report = fake.run(fake.work(ROWS, (9,), "hangs"), out)
    assert (report.done + report.skipped, report.failed) == (ROWS, 0)
    assert report.skipped == before
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
    assert report == Report(done=6, skipped=0, failed=2)
    assert fake.content(merged) == fake.content(tmp_path / "whole")
    assert merge(parts, merged, progress=False).done == 0
    fake.run(items, tmp_path / "other", dataclasses.replace(fake.SETTINGS, seed=1))
    with pytest.raises(InputError, match="seed = 1, not 0"):
        merge([*parts, tmp_path / "other"], merged, progress=False)
    assert fake.run(items, merged, retry_failed=True).done == 2
    assert merge(parts, merged, progress=False) == Report(done=0, skipped=6, failed=0)
    assert check(merged, progress=False) == []


def test_a_part_that_is_not_there_is_refused(fake, tmp_path):
    for shard in ((1, 1), (-1, 2)):
        with pytest.raises(InputError, match="shard"):
            fake.run(fake.work(4), tmp_path / "out", shard=shard)
    assert not (tmp_path / "out").exists()


def test_two_runs_do_not_write_into_one_folder(fake, tmp_path):
    with folder_lock(tmp_path), pytest.raises(InputError, match="another qs3 is writing"):
        fake.run(fake.work(4), tmp_path)
    assert fake.content(tmp_path) == {}


def test_executors_refuse_numbers_out_of_range():
    for options in ({"workers": 0}, {"workers": -1}, {"timeout": 0.0}):
        with pytest.raises(InputError):
            LocalExecutor(**options)
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
