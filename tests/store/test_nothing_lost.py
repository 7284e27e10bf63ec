"""Whatever happens on the way, a data set ends with the same bytes, or says why not."""

import dataclasses
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
from qs3.io.layouts.contents import read_store
from qs3.store.executors import InlineExecutor, LocalExecutor
from qs3.store.failures import read_failures
from qs3.store.generate import GenerateReport, GenerateSettings, generate
from qs3.store.merge import MergeReport, merge
from qs3.store.verify import verify

HERE = Path(__file__).parent
ROWS, ROWS_PER_SHARD = 48, 4
SETTINGS = GenerateSettings(num_points=16, rows_per_shard=ROWS_PER_SHARD)

SCRIPT = """
import sys
sys.path.insert(0, sys.argv[1])
from pathlib import Path
import qs3_fake_scan as fake
from qs3.store.generate import GenerateSettings, generate
from qs3.errors import QS3Error
if __name__ == "__main__":
    settings = GenerateSettings(num_points=16, rows_per_shard=4)
    work = [fake.FakeItem("bad0" if i == 9 else f"m{i}") for i in range(48)]
    try:
        report = generate(
            work, Path(sys.argv[2]), settings, scan_one=getattr(fake, sys.argv[3]), workers=2,
            progress=False,
        )
    except QS3Error as error:
        print(f"qs3: {error}", file=sys.stderr)
        sys.exit(2)
    print(report.done, report.skipped, report.failed)
"""


def work(fake, bad=()):
    return [fake.FakeItem(f"bad{i}" if i in bad else f"m{i}") for i in range(ROWS)]


def content(folder: Path) -> dict[str, bytes]:
    files = (path for path in folder.rglob("*") if path.is_file())
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in files}


@pytest.fixture
def start(tmp_path):
    """Start a run of 48 scans of 50 ms in a process group of its own."""
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


def rows_there(out: Path) -> int:
    """Scans that are written down, in shards or in parts of shards that are not there yet."""
    parts = [path.parent.name for path in out.glob(".parts/*/[0-9]*.parquet")]
    shards = {path.stem.removeprefix("shard-") for path in out.glob("shard-*.parquet")}
    return len(shards) * ROWS_PER_SHARD + sum(shard not in shards for shard in parts)


def kill_at_random_moments(start, tmp_path, kills: int, seed: int) -> list[int]:
    """Kill the run again and again, spread over its length, and let it end; what was there."""
    rng = np.random.default_rng(seed)
    out = tmp_path / "out"
    there, shards = [], []
    for kill in range(kills):
        process = start(out)
        goal = int(ROWS * (kill + rng.random()) / (kills + 1))
        deadline = time.monotonic() + 60
        while rows_there(out) < goal and time.monotonic() < deadline:
            time.sleep(0.002)
        time.sleep(rng.uniform(0, 0.06))  # anywhere within a scan, a write, a shard put together
        assert process.poll() is None, process.communicate()
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate(timeout=60)
        there.append(rows_there(out))
        shards.append(len(list(out.glob("shard-*.parquet"))))
    process = start(out)
    printed, errors = process.communicate(timeout=120)
    assert process.returncode == 0, errors
    done, skipped, failed = map(int, printed.split())
    assert (done + skipped, failed) == (ROWS, 0)
    assert skipped >= there[-1]
    assert there == sorted(there)  # no scan that was written down was ever lost
    return shards


def whole(fake, tmp_path) -> dict[str, bytes]:
    items = [fake.FakeItem("bad0" if i == 9 else f"m{i}") for i in range(ROWS)]
    generate(items, tmp_path / "whole", SETTINGS, scan_one=fake.fake_row, workers=0, progress=False)
    return content(tmp_path / "whole")


@pytest.mark.slow
def test_a_run_killed_at_five_moments_ends_the_same(fake, start, tmp_path):
    kill_at_random_moments(start, tmp_path, kills=5, seed=1)
    assert content(tmp_path / "out") == whole(fake, tmp_path)


@pytest.mark.slow
def test_a_run_killed_at_twenty_moments_ends_the_same(fake, start, tmp_path):
    shards = kill_at_random_moments(start, tmp_path, kills=20, seed=2)
    assert sum(count >= 1 for count in shards) >= 10
    assert content(tmp_path / "out") == whole(fake, tmp_path)


@pytest.mark.parametrize("row", ["slow_row", "hanging_row"])
def test_workers_end_with_the_process_that_started_them(start, tmp_path, row):
    process = start(tmp_path / "out", row)
    deadline = time.monotonic() + 60
    # The tenth object is the one that hangs, with the interpreter locked.
    while rows_there(tmp_path / "out") < 12 and time.monotonic() < deadline:
        time.sleep(0.01)
    workers = children(process.pid)
    assert len(workers) >= 2
    os.kill(process.pid, signal.SIGKILL)
    process.communicate(timeout=30)
    while any(alive(pid) for pid in workers) and time.monotonic() < deadline:
        time.sleep(0.05)
    assert not any(alive(pid) for pid in workers)


def test_a_worker_killed_from_outside_costs_nothing(fake, start, tmp_path):
    process = start(tmp_path / "out")
    deadline = time.monotonic() + 60
    killed = 0
    for goal in (6, 20):
        while rows_there(tmp_path / "out") < goal and time.monotonic() < deadline:
            time.sleep(0.01)
        for pid in children(process.pid)[:2]:
            if b"spawn_main" in Path(f"/proc/{pid}/cmdline").read_bytes():
                os.kill(pid, signal.SIGKILL)
                killed += 1
    printed, errors = process.communicate(timeout=120)
    assert killed >= 2
    assert (process.returncode, printed.split()) == (0, [str(ROWS), "0", "0"]), errors
    assert content(tmp_path / "out") == whole(fake, tmp_path)


@pytest.mark.parametrize("row", ["crash_once_row", "crash_in_write_row", "crash_with_lock_row"])
def test_a_process_that_dies_once_leaves_nothing_undone_and_nothing_behind(
    fake, start, tmp_path, row
):
    marker = tmp_path / "marker"
    process = start(tmp_path / "out", row, env=os.environ | {"QS3_FAKE_MARKER": str(marker)})
    printed, errors = process.communicate(timeout=120)
    assert marker.exists()
    assert (process.returncode, printed.split()) == (0, [str(ROWS), "0", "0"]), errors
    assert content(tmp_path / "out") == whole(fake, tmp_path)


@pytest.mark.parametrize(
    ("row", "kind", "reason"),
    [
        ("hanging_row", "Timeout", "took over 2 s"),
        ("crashing_row", "ProcessDied", "SIGSEGV"),
        ("deadly_row", "ProcessDied", "exit code 9"),
    ],
)
def test_an_object_that_hangs_or_crashes_fails_alone(fake, tmp_path, row, kind, reason):
    report = generate(
        work(fake, bad=[2, 7]),
        tmp_path / "bad",
        SETTINGS,
        scan_one=getattr(fake, row),
        workers=2,
        timeout=2.0 if kind == "Timeout" else 60.0,
        progress=False,
    )
    assert report == GenerateReport(done=ROWS - 2, skipped=0, failed=2)
    failures = read_failures(tmp_path / "bad")
    assert [(record["id"], record["error"]) for record in failures] == [
        ("bad2#0", kind),
        ("bad7#0", kind),
    ]
    assert all(reason in record["reason"] for record in failures)
    generate(
        work(fake, bad=[2, 7]),
        tmp_path / "raise",
        SETTINGS,
        scan_one=fake.flaky_row,
        workers=0,
        progress=False,
    )
    bad, raised = content(tmp_path / "bad"), content(tmp_path / "raise")
    del bad["failures.jsonl"], raised["failures.jsonl"]
    assert bad == raised
    assert verify(tmp_path / "bad", progress=False) == []


def test_what_failed_is_scanned_again_when_asked(fake, tmp_path, monkeypatch):
    marker = tmp_path / "marker"
    marker.touch()
    monkeypatch.setenv("QS3_FAKE_MARKER", str(marker))

    def run(**how):
        return generate(
            work(fake, bad=[0, 5, 6, 47]),
            tmp_path / "out",
            SETTINGS,
            scan_one=fake.marked_row,
            workers=0,
            progress=False,
            **how,
        )

    assert run() == GenerateReport(done=44, skipped=0, failed=4)
    assert run() == GenerateReport(done=0, skipped=48, failed=0)
    assert run(retry_failed=True) == GenerateReport(done=0, skipped=44, failed=4)
    marker.unlink()
    assert run(retry_failed=True) == GenerateReport(done=4, skipped=44, failed=0)
    assert read_failures(tmp_path / "out") == []
    generate(
        work(fake, bad=[0, 5, 6, 47]),
        tmp_path / "new",
        SETTINGS,
        scan_one=fake.fake_row,
        workers=0,
        progress=False,
    )
    assert content(tmp_path / "out") == content(tmp_path / "new")


def test_a_failure_half_forgotten_does_not_come_back(fake, tmp_path):
    """A row that failed and came later; a power cut while its parts were being removed."""
    how = {"scan_one": fake.fake_row, "workers": 0, "progress": False}
    generate(work(fake), tmp_path / "out", SETTINGS, **how)
    wanted = content(tmp_path / "out")
    left = tmp_path / "out" / ".parts" / "00002" / "000001.json"
    left.parent.mkdir(parents=True)
    left.write_text('{"error": "ValueError", "reason": "broken"}')
    assert generate(work(fake), tmp_path / "out", SETTINGS, **how).done == 0
    assert content(tmp_path / "out") == wanted


def test_a_file_torn_by_a_power_cut_is_swept_away(fake, tmp_path):
    how = {"scan_one": fake.fake_row, "workers": 0, "progress": False}
    generate(work(fake), tmp_path / "whole", SETTINGS, **how)
    out = tmp_path / "out"
    with pytest.raises(KeyboardInterrupt):
        generate(work(fake), out, SETTINGS, **(how | {"scan_one": fake.Interrupting(6)}))
    for torn in (
        ".parts/00001/.000003.parquet.4242.tmp.parquet",
        ".shard-00001.parquet.7.tmp.parquet",
    ):
        (out / torn).write_bytes(b"PAR1")
    generate(work(fake), out, SETTINGS, **how)
    assert content(out) == content(tmp_path / "whole")


def test_a_scan_that_was_made_and_is_gone_is_never_passed_over(fake, tmp_path, monkeypatch):
    """As where machines see two folders under one name."""
    from qs3.store.folder import Folder

    write = Folder.write

    def elsewhere(self, name, data):
        if "00001/000002" not in name:
            write(self, name, data)

    monkeypatch.setattr(Folder, "write", elsewhere)
    how = {"scan_one": fake.fake_row, "workers": 0, "progress": False}
    with pytest.raises(InputError, match=r"shard-00001\.parquet: 1 scans that were made are not"):
        generate(work(fake), tmp_path / "out", SETTINGS, **how)
    monkeypatch.undo()
    assert not (tmp_path / "out" / "shard-00001.parquet").exists()
    generate(work(fake), tmp_path / "whole", SETTINGS, **how)
    generate(work(fake), tmp_path / "out", SETTINGS, **how)
    assert content(tmp_path / "out") == content(tmp_path / "whole")


def test_a_fault_of_the_machine_does_not_go_through_the_whole_list(fake, tmp_path):
    bad = [fake.FakeItem(f"bad{i}", class_name="chair") for i in range(60)]
    items = [*work(fake)[:3], *bad]
    how = {"scan_one": fake.flaky_row, "workers": 0, "progress": False}
    with pytest.raises(InputError, match="50 objects in a row failed, the last with: bad49"):
        generate(items, tmp_path, SETTINGS, **how)
    report = generate(items, tmp_path, SETTINGS, **how)  # and past them, if they are at fault
    assert report == GenerateReport(done=0, skipped=53, failed=10)
    assert verify(tmp_path, progress=False) == []


def test_a_scan_written_by_a_process_that_was_then_killed_counts(fake, tmp_path):
    report = generate(
        work(fake, bad=[5]),
        tmp_path / "out",
        SETTINGS,
        scan_one=fake.late_row,
        workers=1,
        timeout=3.0,
        progress=False,
    )
    assert report == GenerateReport(done=ROWS, skipped=0, failed=0)
    assert verify(tmp_path / "out", progress=False) == []


def test_lost_rows_without_a_record_are_found_by_a_retry(fake, tmp_path, monkeypatch):
    marker = tmp_path / "marker"
    marker.touch()
    monkeypatch.setenv("QS3_FAKE_MARKER", str(marker))
    how = {"scan_one": fake.marked_row, "workers": 0, "progress": False}
    strange = [fake.FakeItem("bad\u2028\u0085é"), *work(fake)[1:]]
    generate(strange, tmp_path / "out", SETTINGS, **how)
    assert [r["object"] for r in read_failures(tmp_path / "out")] == ["bad\u2028\u0085é"]
    marker.unlink()
    (tmp_path / "out" / "failures.jsonl").unlink()
    report = generate(strange, tmp_path / "out", SETTINGS, **how, retry_failed=True)
    assert report == GenerateReport(done=1, skipped=ROWS - 1, failed=0)
    generate(strange, tmp_path / "whole", SETTINGS, **how)
    assert content(tmp_path / "out") == content(tmp_path / "whole")


def test_workers_use_one_thread_each():
    pytest.importorskip("threadpoolctl")
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


def test_every_state_between_two_writes_is_mended(fake, tmp_path, monkeypatch):
    """Stop after each single write of a run with failures, and go on: always the same end."""
    from qs3.store.folder import Folder

    class Stop(BaseException):
        """As abrupt as a power cut."""

    items = work(fake, bad=[1])[:10]
    how = {"scan_one": fake.flaky_row, "workers": 0, "progress": False}
    generate(items, tmp_path / "whole", SETTINGS, **how)
    wanted = content(tmp_path / "whole")
    write, remove = Folder.write, Folder.remove
    left = [0]

    def counted(change):
        def changed(self, *arguments):
            if left[0] == 0:
                raise Stop
            left[0] -= 1
            return change(self, *arguments)

        return changed

    monkeypatch.setattr(Folder, "write", counted(write))
    monkeypatch.setattr(Folder, "remove", counted(remove))
    stops = 0
    for steps in range(1, 100):
        out = tmp_path / f"out{steps}"
        left[0] = steps
        try:
            generate(items, out, SETTINGS, **how)
        except Stop:
            stops += 1
        else:
            break
        left[0] = -1
        generate(items, out, SETTINGS, **how)
        assert content(out) == wanted, steps
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
    before = rows_there(out)
    if small_disk is not None:
        subprocess.run(["mount", "-o", "remount,size=4m", str(small_disk)], check=True)
    process = start(out, "fake_row")
    printed, errors = process.communicate(timeout=120)
    assert process.returncode == 0, errors
    done, skipped, failed = map(int, printed.split())
    assert (done + skipped, failed) == (ROWS, 0)
    assert skipped >= before > 0
    assert content(out) == whole(fake, tmp_path)


def test_parts_of_several_machines_merge_into_the_bytes_of_one(fake, tmp_path):
    items = work(fake, bad=[3, 20])

    def run(name, shard):
        return generate(
            items,
            tmp_path / name,
            SETTINGS,
            scan_one=fake.flaky_row,
            workers=0,
            shard=shard,
            progress=False,
        )

    run("whole", (0, 1))
    reports = [run(f"part{i}", (i, 5)) for i in range(5)]
    assert sum(report.done + report.failed for report in reports) == ROWS
    parts = [tmp_path / f"part{i}" for i in range(5)]
    with pytest.raises(InputError, match=r"2 of 12 shards are in none .* \(numbers 4, 9\)"):
        merge(parts[:4], tmp_path / "merged", progress=False)
    assert not (tmp_path / "merged").exists()
    report = merge(parts, tmp_path / "merged", progress=False)
    assert report == MergeReport(copied=12, skipped=0, failed=2)
    assert content(tmp_path / "merged") == content(tmp_path / "whole")
    assert merge(parts, tmp_path / "merged", progress=False).copied == 0
    other = dataclasses.replace(SETTINGS, seed=1)
    generate(items, tmp_path / "other", other, scan_one=fake.flaky_row, workers=0, progress=False)
    with pytest.raises(InputError, match="seed = 1, not 0"):
        merge([*parts, tmp_path / "other"], tmp_path / "merged", progress=False)
    again = generate(
        items,
        tmp_path / "merged",
        SETTINGS,
        scan_one=fake.fake_row,
        workers=0,
        retry_failed=True,
        progress=False,
    )
    assert again.done == 2
    with pytest.raises(InputError, match="neither part's any more"):
        merge(parts, tmp_path / "merged", progress=False)
    assert read_failures(tmp_path / "merged") == []
    (tmp_path / "part2" / "shard-00002.parquet").write_bytes(b"PAR1")
    with pytest.raises(InputError, match=r"part2/shard-00002\.parquet: damaged"):
        merge(parts, tmp_path / "fresh", progress=False)


@pytest.mark.parametrize("shard", [(1, 1), (-1, 2), (5, 2)])
def test_a_part_that_is_not_there_is_refused(fake, tmp_path, shard):
    with pytest.raises(InputError, match="shard"):
        generate(
            work(fake), tmp_path / "out", SETTINGS, scan_one=fake.fake_row, shard=shard, workers=0
        )
    assert not (tmp_path / "out").exists()


def test_two_runs_do_not_write_into_one_folder(fake, start, tmp_path):
    process = start(tmp_path / "out")
    deadline = time.monotonic() + 60
    while rows_there(tmp_path / "out") < 1 and time.monotonic() < deadline:
        time.sleep(0.01)
    os.kill(process.pid, signal.SIGSTOP)  # or it may have ended before the second one looks
    second = start(tmp_path / "out")
    _, errors = second.communicate(timeout=60)
    os.kill(process.pid, signal.SIGCONT)
    assert second.returncode == 2
    assert "another qs3 is writing" in errors
    _, errors = process.communicate(timeout=120)
    assert process.returncode == 0, errors
    assert content(tmp_path / "out") == whole(fake, tmp_path)


def test_half_precision_is_the_nearest_half(fake, tmp_path):
    for dtype in ("float32", "float16"):
        generate(
            work(fake),
            tmp_path / dtype,
            dataclasses.replace(SETTINGS, dtype=dtype),
            scan_one=fake.fake_row,
            workers=0,
            progress=False,
        )
    single, half = (read_store(tmp_path / dtype).points for dtype in ("float32", "float16"))
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
    found = []
    for entry in Path("/proc").iterdir():
        if entry.name.isdigit():
            try:
                fields = (entry / "stat").read_text().rsplit(")", 1)[1].split()
            except OSError:
                continue
            if int(fields[1]) == pid:
                found.append(int(entry.name))
    return sorted(found)


def alive(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rsplit(")", 1)[1].split()[0] != "Z"
    except OSError:
        return False
