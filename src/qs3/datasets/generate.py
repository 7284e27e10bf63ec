"""Scan a list of meshes into a data set: resumable, in parallel, and the same every time.

The work list (objects × scans, in fixed order) is cut into shards of a fixed number of rows. The
process that makes a scan writes it down at once (`qs3.datasets.parts`); a shard is put together
when all its scans are there. An object that fails is logged and absent.
"""

import functools
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from qs3.datasets.executors import Executor, Failure, InlineExecutor, LocalExecutor
from qs3.datasets.executors.executor import stop_if_fatal
from qs3.datasets.failures import read_failures, write_failures
from qs3.datasets.manifest import (
    MANIFEST,
    finished_shards,
    read_sums,
    shard_name,
    write_manifest,
    write_sums,
)
from qs3.datasets.mesh_sums import (
    changed_meshes,
    mesh_sums,
    read_mesh_sums,
    write_mesh_sums,
)
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
from qs3.datasets.plan import Plan, make_plan, resolve_renderer
from qs3.datasets.plan import work_list_checksum as work_list_checksum
from qs3.datasets.progress import progress_bar
from qs3.datasets.scan_item import GenerateSettings as GenerateSettings
from qs3.datasets.scan_item import Item as Item
from qs3.datasets.scan_item import neighbour_of
from qs3.datasets.scan_item import scan_item as scan_item
from qs3.datasets.scan_item import scan_seed as scan_seed
from qs3.datasets.shards import CloudRow
from qs3.datasets.storage import Folder, open_folder
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
            of its scan and the settings, and a second item where the scene has a neighbour.
        workers: Processes of this machine; 0 does the work in this one, where a crash or a hang
            of one scan ends or hangs the run.
        timeout: Seconds that one scan may take in a process; None waits for ever.
        executor: Where the work is done, in place of ``workers`` and ``timeout``.
        shard: ``(i, n)`` makes the shards i, i + n, i + 2n … alone, for one of n machines that
            each write into a folder of their own; `qs3.datasets.merge` puts them together.
        retry_failed: Scan again what failed before.
        progress: Show a bar on the standard error stream.

    Raises:
        InputError: where the list is empty or has equal ids, a class is unknown, the folder holds
            something else or a data set of other settings, another process writes into it, or a
            fault lies with the machine (a missing package, a full disk) and not with an object.
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
    folder.claim(MANIFEST)
    with folder.locked():
        write_manifest(folder, manifest)
        run = _Run(plan, folder, executor, scan_one)
        run.look()
        run.check_meshes()
        run.prepare(range(index, plan.shards, count), retry_failed)
        text = f"{folder.name}: scans" if progress else None
        return run.work(text)


class _Run:
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
            else:
                lost = [p for p in places if p not in parts]
                if retry_failed:
                    lost = [p for p in places if p not in parts or p in self.failures]
            self.todo += lost
            self.missing[shard] = set(lost)

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
