"""Scan a list of meshes into a data set: resumable, in parallel, and the same every time.

The work list (objects × scans, in fixed order) is cut into shards of a fixed number of rows. The
process that makes a scan writes it down at once (`qs3.store.parts`); a shard is put together
when all its scans are there. An object that fails is logged and absent.
"""

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from qs3.errors import InputError
from qs3.store.executors import Executor, Failure, InlineExecutor, LocalExecutor, outcomes
from qs3.store.failures import read_failures, write_failures
from qs3.store.folder import PARTS, Folder, open_folder
from qs3.store.manifest import (
    MANIFEST,
    Sums,
    changed_meshes,
    finished_shards,
    mesh_sums,
    read_mesh_sums,
    shard_name,
    write_manifest,
    write_mesh_sums,
)
from qs3.store.parts import (
    Place,
    finish_shard,
    part_folder,
    read_failure,
    scan_to_part,
    write_failure,
    written_parts,
)
from qs3.store.plan import Plan, make_plan, resolve_renderer
from qs3.store.progress import progress_bar
from qs3.store.scan_item import GenerateSettings as GenerateSettings
from qs3.store.scan_item import Item as Item
from qs3.store.scan_item import scan_item as scan_item
from qs3.store.scan_item import scan_seed as scan_seed
from qs3.store.shards import CloudRow, load_shard

_STOPPED = ("ProcessDied", "Timeout")
_TOO_MANY = 50


@dataclass(frozen=True)
class GenerateReport:
    """What one call of `generate` did, in scans."""

    done: int
    """Scanned and written by this call."""
    skipped: int
    """Finished before."""
    failed: int
    """Failed in this call; each is in ``failures.jsonl``."""


def generate(
    items: Sequence[Item],
    out: str | Path,
    settings: GenerateSettings,
    *,
    scan_one: Callable[..., CloudRow] = scan_item,
    workers: int = 1,
    timeout: float | None = None,
    executor: Executor | None = None,
    shard: tuple[int, int] = (0, 1),
    retry_failed: bool = False,
    progress: bool = True,
) -> GenerateReport:
    """Scan every item into the data set at ``out``, going on where an earlier call stopped.

    The bytes of the shards depend on the items and the settings alone. Ctrl-C lets the scans
    that are under way end, keeps them, and raises ``KeyboardInterrupt``.

    Args:
        items: Meshes, in the order of the rows.
        out: New or empty folder, or one that the same call began; any address that fsspec knows.
        settings: Settings of the data set.
        scan_one: Makes one row; a picklable function of a module. It is handed an item, the index
            of its scan and the settings, and other items, in the order in which they are drawn,
            where the scene has a neighbour.
        workers: Processes of this machine; 0 does the work in this one, where a crash or a hang
            of one scan ends or hangs the run.
        timeout: Seconds that one scan may take in a process; None waits for ever.
        executor: Where the work is done, in place of ``workers`` and ``timeout``.
        shard: ``(i, n)`` makes the shards i, i + n, i + 2n … alone, for one of n machines that
            each write into a folder of their own; `qs3.store.merge` puts them together.
        retry_failed: Scan again what failed before.
        progress: Show a bar on the standard error stream.

    Raises:
        InputError: where the list is empty or has equal ids, a class is unknown, the folder holds
            something else or a data set of other settings, another process writes into it, or a
            fault lies with the machine (a missing package, a full disk, processes that are killed)
            and not with an object.
    """
    index, count = shard
    if not 0 <= index < count:
        raise InputError(f"shard {index}/{count}: the first number goes from 0 to {count - 1}")
    if executor is None:
        executor = InlineExecutor() if workers == 0 else LocalExecutor(workers, timeout)
    settings = settings if scan_one is not scan_item else resolve_renderer(settings)
    plan = make_plan(items, settings)
    manifest = plan.manifest()
    folder = open_folder(out)
    with folder.claimed(MANIFEST):
        write_manifest(folder, manifest)
        run = _Run(plan, folder, scan_one)
        mine = range(index, plan.shards, count)
        run.check_meshes(mine)
        run.list_work(mine, retry_failed)
        return run.work(executor, f"{folder.name}: scans" if progress else None)


class _Run:
    """One call of `generate`: what is there, what is to do, what failed."""

    def __init__(self, plan: Plan, folder: Folder, scan_one: Callable[..., CloudRow]) -> None:
        """Look at what earlier calls left."""
        self.plan, self.folder, self.scan_one = plan, folder, scan_one
        self.parts = written_parts(folder)
        """Rows that lie beside the shards, and the files' names."""
        self.settled = set(finished_shards(folder, plan.shards))
        """Shards that are put together, or all but."""
        self.sums = Sums(folder)
        self.failures = {Place(r["shard"], r["row"]): r for r in read_failures(folder)}
        """What failed, now or before."""
        self.log_is_behind = bool(self.parts)
        """Whether ``failures.jsonl`` may lack something."""
        for place, name in self.parts.items():
            if name.endswith(".json"):
                self.failures[place] = plan.failure_record(place, read_failure(folder, name))
            else:
                self.failures.pop(place, None)
        self.todo: list[tuple[int, list[int]]] = []
        """Rows to scan by shard; the next of both is the last."""
        self.awaited: dict[int, int] = {}
        """How many rows each shard waits for that is not complete."""
        self.complete: list[int] = []
        """Shards that wait for nothing more."""
        self.total = self.left = self.done = self.failed = 0
        self.failed_in_a_row: set[str] = set()
        """Objects that failed since the last that did not."""

    def check_meshes(self, mine: Sequence[int]) -> None:
        """Refuse a mesh that is not the one that was scanned; one that failed may be mended."""
        noted = read_mesh_sums(self.folder)
        now = mesh_sums(self.plan.items_of(mine))
        changed = set(changed_meshes(noted, now))
        if changed:
            scanned = {place for shard in self.settled for place in self.plan.places(shard)}
            for place in sorted((scanned | set(self.parts)) - set(self.failures)):
                name = self.plan.object_of(place)
                if name in changed:
                    raise InputError(
                        f"{name}: the mesh has changed since it was scanned into {self.folder}; "
                        "name another folder, or put the old file back"
                    )
        if not now.items() <= noted.items():
            write_mesh_sums(self.folder, noted | now)

    def list_work(self, mine: Sequence[int], retry_failed: bool) -> None:
        """List the rows to scan and the shards to put together."""
        with_parts = {place.shard for place in self.parts}
        for shard in reversed(mine):
            places = list(self.plan.places(shard))
            self.total += len(places)
            if shard not in self.settled:
                again = self.failures if retry_failed else {}
                lost = [p for p in places if p not in self.parts or p in again]
            else:
                # Parts beside a finished shard: an earlier call was stopped before it tidied up.
                unsettled = shard_name(shard) not in self.sums or shard in with_parts
                absent = self._absent_rows(shard, places) if retry_failed or unsettled else []
                lost = absent if retry_failed else []
                if not lost and not unsettled:
                    continue
            if not lost:
                self.complete.append(shard)
                continue
            self.left += len(lost)
            self.awaited[shard] = len(lost)
            self.todo.append((shard, [place.row for place in reversed(lost)]))

    def _absent_rows(self, shard: int, places: Sequence[Place]) -> list[Place]:
        """Rows that a finished shard lacks; failures of rows that it has are forgotten."""
        present = set(load_shard(self.folder, shard, ["id"])["id"].to_pylist())
        self.log_is_behind = True
        absent = [place for place in places if self.plan.row_id(place) not in present]
        for place in set(places) - set(absent):
            self.failures.pop(place, None)
        return [place for place in absent if not self.parts.get(place, "").endswith(".parquet")]

    def work(self, executor: Executor, text: str | None) -> GenerateReport:
        """Do what is to do; ``text`` stands before the bar."""
        skipped = self.total - self.left
        bar = progress_bar(self.total, text, "scan", skipped)
        with bar, executor:
            try:
                for key, outcome in outcomes(executor, self._next_call, self._name_of):
                    if isinstance(key, Place):
                        self._scanned(key, outcome)
                        bar.set_postfix(failed=self.failed, refresh=False)
                        bar.update()
                    else:
                        self._finished(key, outcome)
            except KeyboardInterrupt:
                bar.set_description("finishing what is under way (Ctrl-C again: not even that)")
                executor.drain()
                raise
            finally:
                self.sums.write()
        if not written_parts(self.folder):
            self.folder.remove(PARTS)
        return GenerateReport(done=self.done, skipped=skipped, failed=self.failed)

    def _next_call(self) -> tuple[Any, ...] | None:
        """Key, function and arguments of what is to be done next."""
        if self.complete:
            shard = self.complete.pop()
            self._log_failures(shard)
            return shard, finish_shard, *self._finish_arguments(shard)
        if not self.todo:
            return None
        shard, rows = self.todo[-1]
        place = Place(shard, rows.pop())
        if not rows:
            self.todo.pop()
        arguments = self.plan.arguments(*self.plan.position(place))
        call = functools.partial(self.scan_one, *arguments)
        return place, scan_to_part, self.folder, place, self.plan.settings.dtype, call

    def _name_of(self, key: Place | int) -> str:
        return self.plan.row_id(key) if isinstance(key, Place) else shard_name(key)

    def _scanned(self, place: Place, outcome: Failure | None) -> None:
        self.awaited[place.shard] -= 1
        if not self.awaited[place.shard]:
            self.complete.append(place.shard)
        if outcome is not None and outcome.kind in _STOPPED:
            # It may have been stopped when its row was written and the answer was not yet here.
            outcome = None if self.folder.exists(f"{place.stem}.parquet") else outcome
        if outcome is None:
            self.done += 1
            self.failed_in_a_row.clear()
            self.log_is_behind |= self.failures.pop(place, None) is not None
            return
        self.failed += 1
        self.log_is_behind = True
        self.failures[place] = self.plan.failure_record(place, outcome)
        if outcome.kind in _STOPPED:  # it could not write this itself
            write_failure(self.folder, place, outcome)
        self.failed_in_a_row.add(self.plan.object_of(place))
        if len(self.failed_in_a_row) >= _TOO_MANY:
            raise InputError(
                f"{_TOO_MANY} objects in a row failed, the last with: {outcome.reason}; if the "
                "fault is the machine's, mend it and add --retry-failed; if it is theirs, run the "
                "same command again to go on past them"
            )

    def _log_failures(self, shard: int) -> None:
        """Log before the shard is there: afterwards nobody would ask why a row is missing."""
        self.settled.add(shard)
        if self.log_is_behind:
            records = {
                place: r for place, r in self.failures.items() if place.shard in self.settled
            }
            write_failures(self.folder, records.values())
            self.log_is_behind = len(records) < len(self.failures)

    def _finish_arguments(self, shard: int) -> tuple[Any, ...]:
        places = list(self.plan.places(shard))
        order = [self.plan.row_id(place) for place in places]
        failed = [self.plan.row_id(place) for place in places if place in self.failures]
        return self.folder, shard, self.plan.settings.dtype, order, failed

    def _finished(self, shard: int, outcome: str | Failure) -> None:
        if isinstance(outcome, Failure) and outcome.kind in _STOPPED:
            outcome = finish_shard(*self._finish_arguments(shard))
        name = shard_name(shard)
        if isinstance(outcome, Failure):
            where = str(self.folder)
            reason = outcome.reason
            raise InputError(reason if where in reason else f"{where}/{name}: {reason}")
        if not self.folder.exists(name):
            raise InputError(
                f"{self.folder}/{name}: was written, but is not there; do all processes see one "
                "and the same folder? Mend that and run the same command again"
            )
        self.sums.note(name, outcome)
        self.folder.remove(part_folder(shard))
