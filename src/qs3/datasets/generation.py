"""One call of ``generate``: what is there, what is under way, what is logged."""

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from qs3.datasets.executors import Executor, Failure
from qs3.datasets.executors.executor import stop_if_fatal
from qs3.datasets.failures import read_failures, write_failures
from qs3.datasets.manifest import finished_shards, read_sums, shard_name, write_sums
from qs3.datasets.mesh_sums import changed_meshes, mesh_sums, read_mesh_sums, write_mesh_sums
from qs3.datasets.parts import (
    PARTS,
    Place,
    finish_shard,
    part_folder,
    parts_there,
    read_failure,
    scan_to_part,
    write_failure,
)
from qs3.datasets.plan import Plan
from qs3.datasets.progress import progress_bar
from qs3.datasets.scan_item import neighbour_of
from qs3.datasets.shards import CloudRow, parse_shard
from qs3.datasets.storage import Folder
from qs3.errors import InputError


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

    def look(self) -> None:
        """Look at what is there."""
        folder, plan = self.folder, self.plan
        self.sums = read_sums(folder)
        self.settled = set(finished_shards(folder, plan.shards))
        self.parts = parts_there(folder)
        for record in read_failures(folder):
            self.failures[Place(record["shard"], record["row"])] = record
        for place, name in self.parts.items():
            if name.endswith(".json"):
                self.failures[place] = self._record(place, read_failure(folder, name))
            else:
                self.failures.pop(place, None)

    def check_meshes(self) -> None:
        """Refuse a mesh that is not the one that was scanned; one that failed may be mended."""
        there, now = read_mesh_sums(self.folder), mesh_sums(self.plan.items)
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
        if there != now:
            write_mesh_sums(self.folder, now)

    def prepare(self, mine: Sequence[int], retry_failed: bool) -> None:
        """List what is to do."""
        plan, finished, parts = self.plan, set(self.settled), self.parts
        for shard in mine:
            places = list(plan.places(shard))
            self.total += len(places)
            if shard in finished:
                lost = [p for p in places if p in self.failures] if retry_failed else []
                # Parts beside a finished shard: an earlier call was stopped before it tidied up.
                unsettled = shard_name(shard) not in self.sums or any(
                    place.shard == shard for place in parts
                )
                if not lost and not unsettled:
                    continue
                if unsettled:
                    self._forget_what_is_there(shard, places)
                    lost = [p for p in lost if p in self.failures]
            else:
                lost = [p for p in places if p not in parts]
                if retry_failed:
                    lost = [p for p in places if p not in parts or p in self.failures]
            self.todo += lost
            self.missing[shard] = set(lost)

    def _forget_what_is_there(self, shard: int, places: Sequence[Place]) -> None:
        """Drop failures whose rows came later: their parts were half removed."""
        name = shard_name(shard)
        table = parse_shard(self.folder.read(name), f"{self.folder}/{name}", ["id"])
        there = set(table["id"].to_pylist())
        for place in places:
            if self.plan.row_id(place) in there:
                self.failures.pop(place, None)

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
        item, scan = self.plan.work(place)
        settings = self.plan.settings
        others = ()
        if settings.scene.needs_neighbour:
            others = (neighbour_of(item, scan, self.plan.items, settings.seed),)
        call = functools.partial(self.scan_one, item, scan, settings, *others)
        self.executor.submit(place, scan_to_part, self.folder, place, settings.dtype, call)

    def _scanned(self, place: Place, outcome: Failure | None) -> None:
        self.missing[place.shard].discard(place)
        if outcome is None:
            self.done += 1
            self.failures.pop(place, None)
            return
        self.failed += 1
        self.failures[place] = self._record(place, outcome)
        if outcome.kind in ("ProcessDied", "Timeout"):  # it could not write this itself
            write_failure(self.folder, place, outcome)

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
        write_failures(
            self.folder, [r for place, r in self.failures.items() if place.shard in self.settled]
        )
        order = [self.plan.row_id(place) for place in self.plan.places(shard)]
        dtype = self.plan.settings.dtype
        self.executor.submit(shard, finish_shard, self.folder, shard, dtype, order)

    def _finished(self, shard: int, outcome: str | Failure) -> None:
        if isinstance(outcome, Failure):
            raise InputError(outcome.reason)
        self.sums[shard_name(shard)] = outcome
        write_sums(self.folder, self.sums)
        self.folder.remove(part_folder(shard))
