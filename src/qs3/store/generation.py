"""One call of ``generate``: what is there, what is under way, what is logged."""

import functools
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from qs3.errors import InputError
from qs3.store.executors import Executor, Failure
from qs3.store.executors.executor import stop_if_fatal
from qs3.store.failures import read_failures, write_failures
from qs3.store.folder import Folder
from qs3.store.manifest import finished_shards, read_sums, shard_name, write_sums
from qs3.store.mesh_sums import changed_meshes, mesh_sums, read_mesh_sums, write_mesh_sums
from qs3.store.parts import (
    PARTS,
    Place,
    finish_shard,
    part_folder,
    parts_there,
    read_failure,
    scan_to_part,
    write_failure,
)
from qs3.store.plan import Plan
from qs3.store.progress import progress_bar
from qs3.store.shards import CloudRow, parse_shard

_KILLED = ("ProcessDied", "Timeout")
_TOO_MANY = 50
_SUMS_EVERY = 5.0  # seconds; the whole file is written anew each time


@dataclass(frozen=True)
class GenerateReport:
    """What one call of `generate` did, in scans."""

    done: int
    """Scanned and written by this call."""
    skipped: int
    """Finished before."""
    failed: int
    """Failed in this call; each is in ``failures.jsonl``."""


class Generation:
    """One call of `generate`: what is there, what is under way, what is logged."""

    def __init__(
        self,
        plan: Plan,
        folder: Folder,
        executor: Executor,
        scan_one: Callable[..., CloudRow],
    ) -> None:
        self.plan, self.folder, self.executor = plan, folder, executor
        self.scan_one = scan_one
        self.todo: list[Place] = []
        """Rows to scan, in order."""
        self.missing: dict[int, set[Place]] = {}
        """Rows that each unfinished shard waits for."""
        self.failures: dict[Place, dict[str, Any]] = {}
        """What failed, now or before."""
        self.settled: set[int] = set()
        """Shards that are put together, or all but."""
        self.total = self.done = self.failed = 0
        self.unlogged = False
        """Whether the log of failures is behind what is known."""
        self.in_a_row: set[str] = set()
        """Objects that failed since the last that did not."""
        self.summed = time.monotonic()
        self.summed_up: dict[str, str] = {}

    def look(self) -> None:
        """Look at what is there."""
        folder, plan = self.folder, self.plan
        self.sums = read_sums(folder)
        self.summed_up = dict(self.sums)
        self.settled = set(finished_shards(folder, plan.shards))
        self.parts = parts_there(folder)
        for record in read_failures(folder):
            self.failures[Place(record["shard"], record["row"])] = record
        for place, name in self.parts.items():
            self.unlogged = True
            if name.endswith(".json"):
                self.failures[place] = self._record(place, read_failure(folder, name))
            else:
                self.failures.pop(place, None)

    def check_meshes(self, mine: Sequence[int]) -> None:
        """Refuse a mesh that is not the one that was scanned; one that failed may be mended."""
        there = read_mesh_sums(self.folder)
        now = mesh_sums(self.plan.items_of(mine))
        changed = set(changed_meshes(there, now))
        if changed:
            scanned = {place for place, name in self.parts.items() if name.endswith(".parquet")}
            scanned |= {place for shard in self.settled for place in self.plan.places(shard)}
            for place in sorted(scanned - set(self.failures), key=lambda p: (p.shard, p.row)):
                name = self.plan.work(place)[0].id
                if name in changed:
                    raise InputError(
                        f"{name}: the mesh has changed since it was scanned into {self.folder}; "
                        "name another folder, or put the old file back"
                    )
        if not now.items() <= there.items():
            write_mesh_sums(self.folder, there | now)

    def prepare(self, mine: Sequence[int], retry_failed: bool) -> None:
        """List what is to do."""
        plan, finished, parts = self.plan, set(self.settled), self.parts
        for shard in mine:
            places = list(plan.places(shard))
            self.total += len(places)
            if shard in finished:
                lost = self._missing_rows(shard, places) if retry_failed else []
                # Parts beside a finished shard: an earlier call was stopped before it tidied up.
                unsettled = shard_name(shard) not in self.sums or any(
                    place.shard == shard for place in parts
                )
                if not lost and not unsettled:
                    continue
                if unsettled and not retry_failed:
                    self._missing_rows(shard, places)
            else:
                lost = [p for p in places if p not in parts]
                if retry_failed:
                    lost = [p for p in places if p not in parts or p in self.failures]
            self.todo += lost
            self.missing[shard] = set(lost)

    def _missing_rows(self, shard: int, places: Sequence[Place]) -> list[Place]:
        """Rows that a finished shard lacks; failures of rows that it has are forgotten."""
        name = shard_name(shard)
        table = parse_shard(self.folder.read(name), f"{self.folder}/{name}", ["id"])
        there = set(table["id"].to_pylist())
        self.unlogged = True
        missing = [place for place in places if self.plan.row_id(place) not in there]
        for place in set(places) - set(missing):
            self.failures.pop(place, None)
        written = {p for p, part in self.parts.items() if part.endswith(".parquet")}
        return [place for place in missing if place not in written]

    def work(self, text: str | None) -> GenerateReport:
        """Do what is to do."""
        skipped = self.total - len(self.todo)
        bar = progress_bar(self.total, text, "scan", skipped)
        with bar, self.executor:
            try:
                self._loop(bar)
            except KeyboardInterrupt:
                bar.set_description("finishing what is under way (Ctrl-C again: not even that)")
                self.executor.drain()
                raise
            finally:
                self._write_sums()
        if not parts_there(self.folder):
            self.folder.remove(PARTS)
        return GenerateReport(done=self.done, skipped=skipped, failed=self.failed)

    def _loop(self, bar: Any) -> None:
        waiting = iter(self.todo)
        under_way = 0
        for shard in [shard for shard, lost in self.missing.items() if not lost]:
            self._submit_finish(shard)
            under_way += 1
        while True:
            while under_way < self.executor.ahead and (place := next(waiting, None)) is not None:
                self._submit_scan(place)
                under_way += 1
            if not under_way:
                return
            key, outcome = self.executor.next()
            under_way -= 1
            stop_if_fatal(outcome)
            if isinstance(key, Place):
                self._scanned(key, outcome)
                bar.set_postfix(failed=self.failed, refresh=False)
                bar.update()
                if not self.missing[key.shard]:
                    self._submit_finish(key.shard)
                    under_way += 1
            else:
                self._finished(key, outcome)

    def _submit_scan(self, place: Place) -> None:
        call = functools.partial(self.scan_one, *self.plan.arguments(*self.plan.position(place)))
        dtype = self.plan.settings.dtype
        self.executor.submit(place, scan_to_part, self.folder, place, dtype, call)

    def _scanned(self, place: Place, outcome: Failure | None) -> None:
        self.missing[place.shard].discard(place)
        if outcome is not None and outcome.kind in _KILLED:
            # It may have been stopped when its row was written and the answer was not yet here.
            outcome = None if self.folder.exists(f"{place.stem}.parquet") else outcome
        if outcome is None:
            self.done += 1
            self.in_a_row.clear()
            if self.failures.pop(place, None) is not None:
                self.unlogged = True
            return
        self.failed += 1
        self.unlogged = True
        self.failures[place] = self._record(place, outcome)
        if outcome.kind in _KILLED:  # it could not write this itself
            write_failure(self.folder, place, outcome)
        self.in_a_row.add(self.plan.work(place)[0].id)
        if len(self.in_a_row) >= _TOO_MANY:
            raise InputError(
                f"{_TOO_MANY} objects in a row failed, the last with: {outcome.reason}; if the "
                "fault is the machine's, mend it and add --retry-failed; if it is theirs, run the "
                "same command again to go on past them"
            )

    def _record(self, place: Place, failure: Failure) -> dict[str, Any]:
        item, scan = self.plan.work(place)
        return {
            "id": self.plan.row_id(place),
            "object": item.id,
            "scan": scan,
            "class_name": item.class_name,
            "shard": place.shard,
            "row": place.row,
            "error": failure.kind,
            "reason": failure.reason,
        }

    def _submit_finish(self, shard: int) -> None:
        # Logged before the shard is there: afterwards nobody would ask why a row is missing.
        self.settled.add(shard)
        if self.unlogged:
            known = self.failures.items()
            write_failures(self.folder, [r for place, r in known if place.shard in self.settled])
            self.unlogged = any(place.shard not in self.settled for place in self.failures)
        self.executor.submit(shard, finish_shard, *self._finish_arguments(shard))

    def _finish_arguments(self, shard: int) -> tuple[Any, ...]:
        places = list(self.plan.places(shard))
        order = [self.plan.row_id(place) for place in places]
        failed = [self.plan.row_id(place) for place in places if place in self.failures]
        return self.folder, shard, self.plan.settings.dtype, order, failed

    def _finished(self, shard: int, outcome: str | Failure) -> None:
        if isinstance(outcome, Failure) and outcome.kind in _KILLED:
            outcome = finish_shard(*self._finish_arguments(shard))
        name = shard_name(shard)
        if isinstance(outcome, Failure):
            raise InputError(f"{self.folder}/{name}: {outcome.reason}")
        if not self.folder.exists(name):
            raise InputError(
                f"{self.folder}/{name}: was written, but is not there; do all processes see one "
                "and the same folder? Mend that and run the same command again"
            )
        self.sums[name] = outcome
        if time.monotonic() - self.summed > _SUMS_EVERY:
            self._write_sums()
        self.folder.remove(part_folder(shard))

    def _write_sums(self) -> None:
        """Note the checksums; a shard without one is simply put together again."""
        if self.sums != self.summed_up:
            write_sums(self.folder, self.sums)
            self.summed_up = dict(self.sums)
        self.summed = time.monotonic()
